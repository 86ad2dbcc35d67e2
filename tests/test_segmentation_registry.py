"""Registering models: what is accepted, what is refused and with which sentence; the models command."""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from artemis_edge.cli import main
from artemis_edge.errors import InputError
from artemis_edge.segmentation.manifest import Manifest, read_manifest
from artemis_edge.segmentation.network import Network
from artemis_edge.segmentation.registry import (
    STORE_VARIABLE,
    Addition,
    Registry,
    file_hash,
    shipped_folder,
    store_folder,
)
from tests import networks


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(STORE_VARIABLE, str(tmp_path / "store"))
    return tmp_path / "store"


@pytest.fixture
def registry(store: Path, tmp_path: Path) -> Registry:
    """Without the models that ship."""
    return Registry(store, tmp_path / "nothing")


def sha(path: Path) -> dict[str, str]:
    return {"model": hashlib.sha256(path.read_bytes()).hexdigest()}


def add(registry: Registry, path: Path, **more: object) -> Manifest:
    return registry.add(Addition(path, sha(path), **more))[0]  # type: ignore[arg-type]


def refused(registry: Registry, path: Path, **more: object) -> str:
    """The sentence; nothing may be left in the store."""
    with pytest.raises(InputError) as error:
        add(registry, path, **more)
    sentence = str(error.value)
    assert "\n" not in sentence
    assert not registry.store.exists() or list(registry.store.iterdir()) == []
    return sentence


def test_the_kind_is_told_by_the_tensors(registry: Registry, tmp_path: Path) -> None:
    names = {"names": str(dict(enumerate(networks.CLASSES))), "license": "ours"}
    said = add(registry, networks.yolo_export(tmp_path / "a.onnx", metadata=names))
    assert (said.kind, said.classes, said.licence, said.name) == ("yolo-seg", networks.CLASSES, "ours", "a")
    said = add(registry, networks.yolo_raw(tmp_path / "b.onnx"), classes=networks.CLASSES, name="raw")
    assert (said.kind, said.licence, said.inputs) == ("yolo-seg", "not stated", {"images": (1, 3, 0, 0)})
    said = add(registry, networks.semantic(tmp_path / "c.onnx"), classes=("background", *networks.CLASSES))
    assert said.kind == "semantic"
    assert [entry.manifest.name for entry in registry.entries()] == ["a", "c", "raw", "attribute"]
    assert all(entry.open().classes for entry in registry.entries())


def test_models_of_several_files(registry: Registry, tmp_path: Path) -> None:
    model = networks.yolo_export(tmp_path / "f.onnx", classes=1)
    networks.vocabulary(tmp_path / "v.txt")
    parts = {
        "image": networks.image_encoder(tmp_path / "i.onnx"),
        "text": networks.text_encoder(tmp_path / "t.onnx", {}),
        "vocabulary": tmp_path / "v.txt",
    }
    hashes = {"model": file_hash(model), **{role: file_hash(path) for role, path in parts.items()}}
    with pytest.raises(InputError, match="--part image=FILE"):
        registry.add(Addition(model, hashes, "fastsam-clip"))
    with pytest.raises(InputError, match="--sha256 image=H"):
        registry.add(Addition(model, {"model": hashes["model"]}, "fastsam-clip", parts=parts))
    with pytest.raises(InputError, match="no such part"):
        registry.add(Addition(model, hashes, "yolo-seg", parts=parts, classes=("object",)))
    registry.add(Addition(model, hashes, "fastsam-clip", parts=parts, licence="mixed"))
    assert registry.find("f").open().support("anything").reason == ""


def test_a_truncated_file(registry: Registry, tmp_path: Path) -> None:
    path = networks.yolo_export(tmp_path / "a.onnx")
    for share in (0.5, 0.97):
        cut = tmp_path / "cut.onnx"
        cut.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
        assert "may be truncated" in refused(registry, cut, classes=networks.CLASSES)
    for content in (b"", b"not a network", b"\x08\x0a"):
        cut.write_bytes(content)
        assert "cut.onnx" in refused(registry, cut, classes=networks.CLASSES)


def test_the_wrong_hash(registry: Registry, tmp_path: Path) -> None:
    path = networks.semantic(tmp_path / "a.onnx")
    for given, expected in (
        ("0" * 64, "damaged or another file"),
        ("", "with --sha256 H"),
        ("xyz", "is not a SHA-256"),
    ):
        with pytest.raises(InputError, match=expected):
            registry.add(Addition(path, {"model": given}, classes=("a", "b", "c", "d")))
    assert not registry.store.exists()


def test_another_opset(registry: Registry, tmp_path: Path) -> None:
    path = networks.semantic(tmp_path / "a.onnx", opset=99)
    assert "is of ONNX opset 99" in refused(registry, path, classes=("a", "b", "c", "d"))


def test_the_wrong_signature(registry: Registry, tmp_path: Path) -> None:
    encoder = networks.image_encoder(tmp_path / "e.onnx")
    assert "of no kind that is known here" in refused(registry, encoder)
    assert "is not a network of kind yolo-seg" in refused(registry, encoder, kind="yolo-seg", classes=("a",))
    model = networks.yolo_export(tmp_path / "a.onnx")
    assert "is not a network of kind semantic" in refused(registry, model, kind="semantic", classes=("a",))
    assert "has 3 classes and 2 names were given" in refused(registry, model, classes=("a", "b"))
    assert "has 3 classes and 0 names were given" in refused(registry, model)
    assert "names both class 0 and class 2" in refused(registry, model, classes=("a", "b", "a"))
    assert "FastSAM has one" in refused(registry, model, kind="fastsam-clip")


def test_tensors_larger_than_any_picture(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"tensor 'images' of 1 x 3 x 40000 x 40000, too large"):
        Network(networks.semantic(tmp_path / "m.onnx", (40_000, 40_000)))


def test_what_shows_only_when_it_runs(registry: Registry, tmp_path: Path) -> None:
    """Files that leave the number of classes open, and numbers that are none."""
    model = networks.yolo_export(tmp_path / "y.onnx", told=False)
    for names in (("a", "b"), tuple("abcdefghij")):
        assert "3 classes" in refused(registry, model, classes=names)
    model = networks.semantic(tmp_path / "s.onnx", told=False)
    assert "4 classes" in refused(registry, model, classes=("a", "b"))
    model = networks.semantic(tmp_path / "n.onnx", bias=float("nan"))
    assert "gives values that are no numbers" in refused(registry, model, classes=tuple("abcd"))
    model = networks.semantic(tmp_path / "f.onnx", (100, 100))  # the pooling leaves 25 x 25 cells
    assert add(registry, model, classes=tuple("abcd")).outputs == {"logits": (1, 4, 25, 25)}


def test_a_fine_size(registry: Registry, tmp_path: Path) -> None:
    names, size = tuple("abcd"), {"input_size": (64, 96)}
    path = networks.semantic(tmp_path / "s.onnx")
    for fine in ((64, 96), (96, 64)):
        assert "is not finer than the input size 64x96" in refused(
            registry, path, classes=names, fine_input_size=fine, **size
        )
    one_size = networks.semantic(tmp_path / "o.onnx", (64, 96))
    assert "of one size only" in refused(registry, one_size, classes=names, fine_input_size=(128, 192))
    one_side = networks.semantic(tmp_path / "h.onnx", (64, None))  # runs at 64 rows, not at 128
    assert "does not run on this input" in refused(
        registry, one_side, classes=names, fine_input_size=(128, 192), **size
    )
    assert add(registry, path, classes=names, fine_input_size=(96, 144), **size).fine_input_size == (96, 144)
    assert registry.find().open(fine=True).segment(np.zeros((96, 144, 3), np.uint8), []).dense.score.shape == (
        24, 36, 1,
    )  # fmt: skip
    manifest = registry.store / "s" / "manifest.json"
    manifest.write_text(manifest.read_text().replace("144", "32"))
    with pytest.raises(InputError, match="fine_input_size is smaller than input_size"):
        registry.find("s").open()


def test_flipped_bytes_are_one_sentence_or_work(
    registry: Registry, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    whole = networks.semantic(tmp_path / "s.onnx").read_bytes()
    rng = np.random.default_rng(7)
    refusals = 0
    for _ in range(40):
        content = bytearray(whole)
        content[rng.integers(len(content))] = rng.integers(256)
        path = tmp_path / "m.onnx"
        path.write_bytes(content)
        try:
            add(registry, path, classes=tuple("abcd"))
            registry.remove("m")
        except InputError as error:
            refusals += 1
            assert "\n" not in str(error)
            assert not registry.store.exists() or list(registry.store.iterdir()) == []
    assert refusals > 5
    assert capfd.readouterr() == ("", "")


def test_names(registry: Registry, tmp_path: Path) -> None:
    path = networks.semantic(tmp_path / "my model.onnx")
    four = ("a", "b", "c", "d")
    assert "cannot be a model's name" in refused(registry, path, classes=four)
    assert "cannot be a model's name" in refused(registry, path, classes=four, name="../x")
    add(registry, path, classes=four, name="mine")
    with pytest.raises(InputError, match="'mine' is there already"):
        add(registry, path, classes=four, name="mine")


def test_choosing_and_removing(registry: Registry, tmp_path: Path) -> None:
    assert registry.find().manifest.name == "attribute"  # rather than nothing
    path = networks.semantic(tmp_path / "a.onnx")
    add(registry, path, classes=("a", "b", "c", "d"))
    assert registry.find().manifest.name == "a"
    add(registry, path, classes=("a", "b", "c", "d"), name="b")
    with pytest.raises(InputError, match=r"several models are registered \(a, b\)"):
        registry.find()
    with pytest.raises(InputError, match="no model named 'x'; registered are: a, b, attribute"):
        registry.remove("x")
    registry.remove("a")
    assert registry.find().manifest.name == "b"


def test_shipped_models_stay(tmp_path: Path, store: Path) -> None:
    """A shipped model is found without a name, is not removed and keeps its name."""
    shipped = tmp_path / "shipped"
    shipped.mkdir()
    path = networks.semantic(shipped / "ours.onnx")
    said = Manifest(
        name="ours", kind="semantic", file="ours.onnx", sha256=file_hash(path), licence="MIT",
        classes=("background", *networks.CLASSES), synthetic_only=True,
    )  # fmt: skip
    (shipped / "ours.json").write_bytes(msgspec.json.encode(said))
    registry = Registry(store, shipped)
    assert (registry.find().shipped, registry.find().manifest.synthetic_only) == (True, True)
    with pytest.raises(InputError, match="ships with the program"):
        registry.remove("ours")
    with pytest.raises(InputError, match="is there already"):
        add(registry, path, classes=said.classes)
    add(registry, path, classes=said.classes, name="mine")
    assert registry.find().manifest.name == "mine"


def test_what_ships_works() -> None:
    for manifest in shipped_folder().glob("*.json"):
        said = read_manifest(manifest)
        assert said.synthetic_only
        assert (shipped_folder() / said.file).stat().st_size <= 1_000_000
        entry = Registry(Path("nowhere")).find(said.name)
        found = entry.open().segment(np.zeros((48, 64, 3), np.uint8), [])
        assert (found.width, found.height) == (64, 48)


def test_damage_is_told(registry: Registry, tmp_path: Path) -> None:
    path = networks.semantic(tmp_path / "a.onnx")
    add(registry, path, classes=("a", "b", "c", "d"))
    stored = registry.store / "a" / "model.onnx"
    stored.write_bytes(stored.read_bytes()[:-1])
    with pytest.raises(InputError, match="is not the file that was registered"):
        registry.find("a").open()
    stored.unlink()
    with pytest.raises(InputError, match="is incomplete"):
        registry.find("a").open()
    (registry.store / "a" / "manifest.json").write_text("{")
    assert "is not a manifest" in registry.entries()[0].problem
    registry.remove("a")
    assert [entry.manifest.name for entry in registry.entries()] == ["attribute"]


def test_where_models_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(STORE_VARIABLE, "/x/y")
    assert store_folder() == Path("/x/y")
    monkeypatch.delenv(STORE_VARIABLE)
    monkeypatch.setenv("XDG_DATA_HOME", "/data")
    assert store_folder() == Path("/data/artemis-edge/models")
    monkeypatch.setenv("XDG_DATA_HOME", "relative")
    assert store_folder() == Path.home() / ".local/share/artemis-edge/models"


# --- the command


def test_the_command(store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = networks.yolo_export(tmp_path / "colours.onnx")
    (tmp_path / "names.txt").write_text("car\nperson\nbench\n\n")
    digest = sha(path)["model"]
    command = ["models", "add", str(path), "--sha256", digest, "--classes", str(tmp_path / "names.txt")]
    assert main([*command, "--licence", "ours"]) == 0
    assert capsys.readouterr().out == "registered colours: yolo-seg, 3 classes, licence: ours\n"
    assert main(["models", "list"]) == 0
    assert "colours: yolo-seg, 3 classes, licence: ours" in capsys.readouterr().out
    cv2.imwrite(str(tmp_path / "p.png"), networks.photograph()[:, :, ::-1])
    asked = ["--image", str(tmp_path / "p.png"), "--query", "cars", "--query", "zorblax", "--json"]
    assert main(["models", "test", "colours", *asked]) == 0
    said = json.loads(capsys.readouterr().out)
    statuses = {answer["text"]: answer["status"] for answer in said["image"]["answers"]}
    assert statuses == {"car": "matched", "zorblax": "unsupported"}
    assert said["image"]["instances"][0]["text"] == "car"
    assert main(["models", "archive", "colours", "--out", str(tmp_path / "a.tar.xz")]) == 0
    assert (tmp_path / "a.tar.xz").stat().st_size > 100
    assert main(["models", "remove", "colours"]) == 0
    capsys.readouterr()
    assert main(["models", "list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["models"]
    assert "colours" not in [model["name"] for model in listed]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["add", "gone.onnx", "--sha256", "0" * 64], "cannot read gone.onnx"),
        (["add", "gone.onnx"], "--sha256 H"),
        (["add", "gone.onnx", "--part", "image"], "write it as ROLE=FILE"),
        (["add", "gone.onnx", "--input-size", "7"], "give height and width"),
        (["add", "gone.onnx", "--fine-input-size", "8x8"], "--fine-input-size 8x8: give height and width"),
        (["add", "gone.onnx", "--classes", "gone.txt"], "cannot read gone.txt"),
        (["remove", "gone"], "no model named 'gone'"),
        (["test", "gone"], "no model named 'gone'"),
        (["test", "--query", "car"], "--query needs a photograph"),
        (["test", "--query"], "expected one argument"),
        (["archive", "attribute", "--out", "x.tar.xz"], "an OAK runs yolo-seg networks"),
    ],
)
def test_bad_use_is_one_sentence(
    arguments: list[str], sentence: str, store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["models", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert sentence in captured.err
    assert captured.err.count("\n") == 1


def test_class_files(tmp_path: Path) -> None:
    from artemis_edge.commands.models import read_classes

    path = tmp_path / "names"
    path.write_text('["traffic light", "car"]')
    assert read_classes(path) == ("traffic light", "car")
    for content in (b"", b"a\n\nb\n", b"[1, 2", b"\xff\xfe"):
        path.write_bytes(content)
        with pytest.raises(InputError):
            read_classes(path)


def test_a_network_leaves_nothing_in_the_home_folder(tmp_path: Path) -> None:
    path, home = networks.semantic(tmp_path / "s.onnx"), tmp_path / "home"
    home.mkdir()
    code = "import sys, pathlib, artemis_edge.segmentation.network as n; n.Network(pathlib.Path(sys.argv[1]))"
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("XDG_", "ORT_"))}
    subprocess.run([sys.executable, "-c", code, str(path)], env=kept | {"HOME": str(home)}, check=True)
    assert list(home.rglob("*")) == []
