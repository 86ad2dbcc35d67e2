"""Backend ``yolo-seg``: a closed list of classes, both tensor layouts of the family (yolo.py)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from artemis_edge.config import SegmentationConfig
from artemis_edge.frames import F32, U8
from artemis_edge.segmentation import scores, yolo
from artemis_edge.segmentation.backend import Instance, Prompt, Segmentation, Status, Support
from artemis_edge.segmentation.letterbox import Letterbox
from artemis_edge.segmentation.manifest import Manifest
from artemis_edge.segmentation.network import Array, Network
from artemis_edge.segmentation.words import canonical

PAD = 114  # grey that the family is trained with


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Least probability of an instance; intersection over union from which a box is a double; most instances."""

    score: float = 0.25
    overlap: float = 0.7
    most: int = 100

    @classmethod
    def by(cls, config: SegmentationConfig) -> Thresholds:
        """As configured."""
        return cls(config.least_score, config.overlap)


def input_sizes(
    network: Network, manifest: Manifest, image: tuple[int, ...]
) -> tuple[list[tuple[int, int]], bool]:
    """Sizes (height, width) to read an ``image`` (height, width, ...) at, coarse first, and whether they are fixed.

    The fine size of the manifest is among them where the image has the pixels: enlarged it would tell nothing new.
    """
    _, _, height, width = next(iter(network.inputs.values()))
    if height is not None and width is not None:
        return [(height, width)], True
    sizes, fine = [manifest.input_size], manifest.fine_input_size
    if fine is not None and (image[0] >= fine[0] or image[1] >= fine[1]):
        sizes.append(fine)
    return sizes, False


def instances(
    found: yolo.Candidates,
    protos: F32,
    box: Letterbox,
    prompts: Sequence[Prompt],
    labels: Sequence[str],
) -> list[Instance]:
    """Masks of the boxes; column k of ``found`` is prompt k, which the model calls ``labels[k]``."""
    _, high, wide = protos.shape
    grid = box.grid(wide, high)
    per_cell = box.width / wide
    in_image = box.to_image(found.box)
    out = []
    for k, column in enumerate(found.column):
        mask, x, y = yolo.crop_mask(protos, found.coefficients[k], found.box[k] / per_cell)
        if not mask.size:  # a box in the padding
            continue
        prompt, probability = prompts[column], float(found.score[k])
        left, top, right, bottom = (float(v) for v in in_image[k])
        edges = (left, top, right, bottom)
        out.append(
            Instance(prompt.slot, prompt.text, labels[column], probability, edges, mask, grid.cropped(x, y))
        )
    return out


class YoloSeg:
    """Looks for the classes that the network was trained with."""

    def __init__(self, network: Network, manifest: Manifest, thresholds: Thresholds) -> None:
        self.name = manifest.name
        self.classes = manifest.classes
        self._network = network
        self._manifest = manifest
        self._thresholds = thresholds
        self._column = {canonical(label): k for k, label in reversed(list(enumerate(manifest.classes)))}

    def support(self, text: str) -> Support:
        """Whether it is one of the classes."""
        return closed_support(self.name, self._column, text)

    def segment(self, image: U8, prompts: Sequence[Prompt]) -> Segmentation:
        """Instances of the prompts by the network; see :class:`Backend`."""
        sizes, fixed = input_sizes(self._network, self._manifest, image.shape)
        box = Letterbox.fit(image.shape[:2], sizes[-1], fixed, self._manifest.stride, centred=True)
        outputs = self._network.run(box.fill(image, PAD, self._manifest.mean, self._manifest.std))
        return self.decode(outputs, box, prompts)

    def decode(self, outputs: Mapping[str, Array], box: Letterbox, prompts: Sequence[Prompt]) -> Segmentation:
        """From the tensors of the network to instances; they may come from another processor."""
        support = [self.support(prompt.text) for prompt in prompts]
        known = [p for p, s in zip(prompts, support, strict=True) if s.status is not Status.UNSUPPORTED]
        columns = [self._column[prompt.text] for prompt in known]
        limits = self._thresholds
        yolo.check_classes(outputs, len(self.classes), self.name)
        raw, protos = yolo.candidates(outputs, columns, limits.score)
        labels = [self.classes[column] for column in columns]
        found = instances(yolo.suppress(raw, limits.overlap, limits.most), protos, box, known, labels)
        return assemble(box, protos.shape[1:], prompts, support, found)


def assemble(
    box: Letterbox,
    size: tuple[int, ...],
    prompts: Sequence[Prompt],
    support: Sequence[Support],
    found: Sequence[Instance],
) -> Segmentation:
    """The answer of a backend whose masks lie on the grid of ``size`` (h, w) over the whole input."""
    high, wide = size
    return Segmentation(
        box.image[0],
        box.image[1],
        scores.answers(prompts, support, found),
        tuple(found),
        scores.dense_scores(found, prompts, (high, wide), box.grid(wide, high)),
    )


def closed_support(name: str, known: Mapping[str, int], text: str) -> Support:
    """Support of a model with a closed list of classes, by their canonical names."""
    if text in known:
        return Support(Status.MATCHED)
    return Support(Status.UNSUPPORTED, f"the model {name} does not know '{text}'")
