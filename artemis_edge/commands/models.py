"""``artemis-edge models``: the segmentation networks that can be used."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from artemis_edge.commands.common import DONE, command, json_option, print_json
from artemis_edge.errors import InputError

if TYPE_CHECKING:
    from artemis_edge.segmentation.backend import Segmentation
    from artemis_edge.segmentation.registry import Entry

_KINDS = ("yolo-seg", "fastsam-clip", "openvocab-seg", "semantic")


def add(commands: Any) -> None:
    """Declare ``models``."""
    group = commands.add_parser("models", help="segmentation networks: list, register, remove, try")
    actions = group.add_subparsers(title="actions", metavar="ACTION", required=True)
    json_option(command(actions, "list", run_list, "models that can be used"))
    _add_parser(actions)
    remove = command(actions, "remove", run_remove, "forget a registered model and delete its files")
    remove.add_argument("name", metavar="NAME")
    json_option(remove)
    test = command(actions, "test", run_test, "run a model on an image of noise, or on yours")
    test.add_argument("name", nargs="?", default="", metavar="NAME", help="default: the one that is used")
    test.add_argument("--image", type=Path, metavar="FILE", help="a photograph to look at")
    test.add_argument("--query", action="append", default=[], metavar="TEXT", help="what to look for in it")
    json_option(test)

    archive = command(actions, "archive", run_archive, "pack a registered yolo-seg network for an OAK camera")
    archive.add_argument("name", metavar="NAME")
    archive.add_argument(
        "--compiled", type=Path, metavar="FILE", help="compiled for the device (default: its ONNX file)"
    )
    archive.add_argument("--out", type=Path, required=True, metavar="FILE.tar.xz")


def _add_parser(actions: Any) -> None:
    parser = command(actions, "add", run_add, "register an ONNX file after trying it")
    parser.add_argument("file", type=Path, metavar="FILE")
    parser.add_argument(
        "--sha256", action="append", default=[], metavar="H",
        help="its SHA-256; of a further file: ROLE=H",
    )  # fmt: skip
    parser.add_argument("--kind", choices=_KINDS, help="default: what its tensors tell")
    parser.add_argument("--name", metavar="NAME", help="default: the file's name")
    parser.add_argument("--licence", metavar="TEXT", help="default: what the file says")
    parser.add_argument("--classes", type=Path, metavar="FILE", help="class names, one a line or a JSON list")
    parser.add_argument(
        "--part", action="append", default=[], metavar="ROLE=FILE",
        help="a further file: image, text (encoders), vocabulary, embeddings",
    )  # fmt: skip
    parser.add_argument(
        "--input-size", metavar="HxW", help="for networks that take any size (default: 480x640)"
    )
    parser.add_argument(
        "--fine-input-size", metavar="HxW",
        help="reprocess and ask read large photographs at this size, too (networks that take any size)",
    )  # fmt: skip
    parser.add_argument("--synthetic-only", action="store_true", help="trained on virtual worlds")
    json_option(parser)


def run_add(given: argparse.Namespace) -> int:
    """``artemis-edge models add``."""
    from artemis_edge.segmentation.registry import Addition, Registry

    wanted = Addition(
        file=given.file,
        sha256=_hashes(given.sha256),
        kind=given.kind,
        name=given.name,
        licence=given.licence,
        classes=() if given.classes is None else read_classes(given.classes),
        parts={role: Path(file) for role, file in _pairs("--part", given.part)},
        input_size=None if given.input_size is None else _size("--input-size", given.input_size),
        fine_input_size=(
            None if given.fine_input_size is None else _size("--fine-input-size", given.fine_input_size)
        ),
        synthetic_only=given.synthetic_only,
    )
    manifest, smoke = Registry().add(wanted)
    if given.json:
        import msgspec

        print_json({"model": msgspec.to_builtins(manifest), "cpu_ms": smoke.ms})
    else:
        count = f"{len(manifest.classes)} classes" if manifest.classes else "any words"
        print(f"registered {manifest.name}: {manifest.kind}, {count}, licence: {manifest.licence}")
    return DONE


def run_list(given: argparse.Namespace) -> int:
    """``artemis-edge models list``."""
    from artemis_edge.segmentation.registry import Registry

    entries = Registry().entries()
    if given.json:
        print_json({"models": [_entry_json(entry) for entry in entries]})
    else:
        print("\n".join(_entry_text(entry) for entry in entries))
    return DONE


def run_remove(given: argparse.Namespace) -> int:
    """``artemis-edge models remove``."""
    from artemis_edge.segmentation.registry import Registry

    Registry().remove(given.name)
    if given.json:
        print_json({"removed": given.name})
    else:
        print(f"removed {given.name}")
    return DONE


def run_test(given: argparse.Namespace) -> int:
    """``artemis-edge models test``."""
    from artemis_edge.segmentation.opening import smoke_test
    from artemis_edge.segmentation.registry import Registry

    if given.query and given.image is None:
        raise InputError("--query needs a photograph to look at: give --image FILE")
    entry = Registry().find(given.name)
    backend = entry.open(fine=True)
    smoke = smoke_test(backend)
    result: dict[str, Any] = {"name": backend.name, "cpu_ms": round(smoke.ms, 2), "classes": backend.classes}
    if given.image is not None:
        from artemis_edge.segmentation.trial import look

        result["image"] = _found_json(look(backend, given.image, given.query))
    if given.json:
        print_json(result)
    else:
        print(_test_text(result))
    return DONE


def run_archive(given: argparse.Namespace) -> int:
    """``artemis-edge models archive``."""
    from artemis_edge.export.places import check_file
    from artemis_edge.segmentation.oak import write_archive
    from artemis_edge.segmentation.registry import Registry

    entry = Registry().find(given.name)
    check_file("--out", given.out, (".xz",), (given.compiled,))
    write_archive(given.out, entry.manifest, given.compiled or entry.folder / entry.manifest.file)
    return DONE


def read_classes(path: Path) -> tuple[str, ...]:
    """Class names of a file: a JSON list, or one a line."""
    try:
        text = path.read_text("utf-8")
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not text; give class names, one a line") from None
    if text.lstrip().startswith("["):
        try:
            names = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path} is not a JSON list of names: {error}") from None
    else:
        names = text.splitlines()
    names = [str(name).strip() for name in names]
    names = names[: len(names) - next((k for k, name in enumerate(reversed(names)) if name), len(names))]
    if not names or not all(names):
        raise InputError(f"{path}: every class needs a name, one a line")
    return tuple(names)


def _hashes(texts: Iterable[str]) -> dict[str, str]:
    """``H`` is that of the network, ``ROLE=H`` that of a further file."""
    return {
        role if equals else "model": value if equals else role for role, equals, value in map(_split, texts)
    }


def _split(text: str) -> tuple[str, str, str]:
    return text.partition("=")


def _pairs(option: str, texts: Iterable[str]) -> Iterable[tuple[str, str]]:
    for text in texts:
        role, equals, value = _split(text)
        if not (role and equals and value):
            raise InputError(f"{option} {text}: write it as ROLE=FILE, for example vocabulary=words.txt.gz")
        yield role, value


def _size(option: str, text: str) -> tuple[int, int]:
    height, _, width = text.lower().partition("x")
    if not (
        height.isdecimal() and width.isdecimal() and 32 <= int(height) <= 4096 and 32 <= int(width) <= 4096
    ):
        raise InputError(f"{option} {text}: give height and width of 32 to 4096 pixels, for example 480x640")
    return int(height), int(width)


def _entry_json(entry: Entry) -> dict[str, Any]:
    import msgspec

    said: dict[str, Any] = msgspec.to_builtins(entry.manifest)
    return {**said, "shipped": entry.shipped, "folder": str(entry.folder), "problem": entry.problem}


def _entry_text(entry: Entry) -> str:
    said = entry.manifest
    if entry.problem:
        return f"{said.name}: not usable: {entry.problem}"
    if said.kind == "attribute":
        return f"{said.name}: {said.note}"
    marks = ["ships with the program"] if entry.shipped else []
    marks += ["for virtual worlds only, of no use on photographs"] if said.synthetic_only else []
    count = f"{len(said.classes)} classes" if said.classes else "any words"
    return "; ".join([f"{said.name}: {said.kind}, {count}, licence: {said.licence}", *marks])


def _found_json(found: Segmentation) -> dict[str, Any]:
    return {
        "answers": [
            {"text": a.prompt.text, "status": str(a.status), "score": round(a.score, 4), "reason": a.reason}
            for a in found.answers
        ],
        "instances": [
            {
                "text": item.text,
                "label": item.label,
                "score": round(item.probability, 4),
                "box": [round(edge, 1) for edge in item.box],
            }
            for item in found.instances
        ],
    }


def _test_text(result: dict[str, Any]) -> str:
    lines = [f"{result['name']} works: {result['cpu_ms']:.0f} ms of CPU an image"]
    for answer in result.get("image", {}).get("answers", []):
        why = f" ({answer['reason']})" if answer["reason"] else ""
        lines.append(f"{answer['text']}: {answer['status']}, {answer['score']:.2f}{why}")
    return "\n".join(lines)
