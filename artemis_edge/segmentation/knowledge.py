"""What a model knows, by its manifest: for the process that asks and does not run it."""

from __future__ import annotations

from artemis_edge.segmentation.attribute import AttributeBackend
from artemis_edge.segmentation.backend import Status, Support
from artemis_edge.segmentation.manifest import Manifest
from artemis_edge.segmentation.words import canonical

_BACKGROUND = "background"


class Knowledge:
    """Answers as the backend of the model would, without opening its files."""

    def __init__(self, manifest: Manifest) -> None:
        self.name = manifest.name
        self.classes = manifest.classes
        self._by_size = AttributeBackend() if manifest.kind == "attribute" else None
        names = {canonical(name) for name in manifest.classes}
        self._known = names - {_BACKGROUND} if manifest.kind == "semantic" else names
        self._any_text = (
            manifest.kind in ("fastsam-clip", "openvocab-seg") and "embeddings" not in manifest.parts
        )

    def support(self, text: str) -> Support:
        """Whether the model can look for a base class."""
        if self._by_size is not None:
            return self._by_size.support(text)
        if text and (self._any_text or text in self._known):
            return Support(Status.MATCHED)
        return Support(Status.UNSUPPORTED, f"the model {self.name} does not know '{text}'")
