"""Settings: every number has finite limits at both ends and nothing beyond them is taken."""

import math
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.inspect import FloatType, IntType, Metadata, StructType, type_info

from artemis_edge.config import Config, from_toml, load, profiles, to_toml
from artemis_edge.errors import InputError


def _number(kind: Any) -> FloatType | IntType | None:
    kind = kind.type if isinstance(kind, Metadata) else kind
    return kind if isinstance(kind, FloatType | IntType) else None


def _numbers() -> list[tuple[str, str, FloatType | IntType]]:
    """Section, field and limits of every number of the configuration."""
    root = type_info(Config)
    assert isinstance(root, StructType)
    return [
        (section.name, field.name, limits)
        for section in root.fields
        if isinstance(section.type, StructType)
        for field in section.type.fields
        if (limits := _number(field.type)) is not None
    ]


def _ends(limits: FloatType | IntType) -> tuple[float, float, float, float]:
    """Least value, greatest value, the value below and the value above."""
    assert (limits.ge is None) != (limits.gt is None)
    assert (limits.le is None) != (limits.lt is None)
    whole = isinstance(limits, IntType)

    def step(value: float, to: float) -> float:
        return value + int(math.copysign(1, to)) if whole else math.nextafter(value, to)

    low = limits.ge if limits.ge is not None else step(limits.gt or 0, math.inf)
    high = limits.le if limits.le is not None else step(limits.lt or 0, -math.inf)
    return low, high, step(low, -math.inf), step(high, math.inf)


def _load(section: str, field: str, value: float) -> float:
    config = load(sets=[f"{section}.{field}={value!r}"])
    return float(getattr(getattr(config, section), field))


@pytest.mark.parametrize(("section", "field", "limits"), _numbers(), ids=lambda part: str(part)[:24])
def test_every_number_is_bounded(section: str, field: str, limits: FloatType | IntType) -> None:
    low, high, below, above = _ends(limits)
    assert _load(section, field, low) == low
    assert _load(section, field, high) == high
    absurd = [below, above, 10**20, -(10**20), math.inf, -math.inf, math.nan, 1e308, -1e308]
    for value in absurd:
        with pytest.raises(InputError, match=f"{section}.{field}.*docs/tuning.md"):
            _load(section, field, value)
    if low > 0:
        with pytest.raises(InputError):
            _load(section, field, 1e-300)


def test_there_are_numbers_to_walk() -> None:
    assert len(_numbers()) > 30


@pytest.mark.parametrize("profile", [None, *profiles()])
def test_profiles_and_defaults_are_within_the_limits(profile: str | None) -> None:
    config = load(profile=profile)
    assert msgspec.convert(msgspec.to_builtins(config), Config) == config
    assert msgspec.toml.decode(to_toml(config), type=Config) == config


def test_retired_settings_of_earlier_maps_are_passed_over_and_others_are_not(tmp_path: Path) -> None:
    text = "[mesher]\ncoplanar = 0.9\nwell_seen = 1.5\nfresh = 5\n"
    (tmp_path / "config.toml").write_text(text)
    assert from_toml(text) == load(tmp_path / "config.toml") == load(sets=["mesher.fresh=5"])
    for wrong in ("[mesher]\nnonsense = 1\n", "mesher = 3\n"):
        with pytest.raises(InputError, match="configuration"):
            from_toml(wrong)
    with pytest.raises(InputError, match="coplanar"):
        load(sets=["mesher.coplanar=0.9"])
