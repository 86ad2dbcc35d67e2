"""``artemis-edge check``: is this machine ready? One finding a subject, each with what to do about it."""

from __future__ import annotations

import platform
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from artemis_edge import config, health
from artemis_edge.check_finding import Finding
from artemis_edge.errors import UserError

_LEAST_PYTHON = (3, 11)
_LEAST_CORES = 2
_LEAST_DISK_MB = 2000.0


def check(config_file: Path | None = None) -> list[Finding]:
    """Look at everything that can be looked at without a recording.

    ``config_file`` is a rig's (as of ``run --config``), whose devices are then looked at, too, or a mapping's.
    """
    if config_file is not None and _is_rig(config_file):
        return _with_rig(config_file)
    settings, about_settings = _configuration(config_file)
    return _machine(settings, about_settings)


def _with_rig(file: Path) -> list[Finding]:
    from artemis_edge.check_rig import check_rig
    from artemis_edge.service import settings

    try:
        rig = settings.load(file)
    except UserError as error:
        return _machine(config.Config(), Finding("configuration", "fail", str(error)))
    return [*_machine(rig.mapping, Finding("configuration", "ok", f"{file} is valid")), *check_rig(rig)]


def _is_rig(file: Path) -> bool:
    """A profile that ships, or a file that names devices; what cannot be read is left to the mapping's reader."""
    if not file.is_file():
        return not file.suffix and not file.parent.name
    try:
        tree = tomllib.loads(file.read_text())
    except (OSError, ValueError):
        return False
    return bool(tree.keys() & {"lidar", "imu", "camera", "trigger", "service", "calibration"})


def _machine(settings: config.Config, about_settings: Finding) -> list[Finding]:
    return [
        _python(),
        _cores(),
        _memory(settings.voxel_map.memory_budget_mb),
        _disk(),
        about_settings,
        _kernels(),
        _bags(),
    ]


def ready(findings: Sequence[Finding]) -> bool:
    """Nothing fails."""
    return all(finding.status != "fail" for finding in findings)


def to_json(findings: Sequence[Finding]) -> dict[str, Any]:
    """Plain values."""
    return {"ready": ready(findings), "checks": [asdict(finding) for finding in findings]}


def to_text(findings: Sequence[Finding]) -> str:
    """One line a finding."""
    width = max(len(finding.name) for finding in findings)
    return "\n".join(f"{f.status:<4}  {f.name:<{width}}  {f.detail}" for f in findings)


def _python() -> Finding:
    good = sys.version_info >= _LEAST_PYTHON
    return Finding(
        "python", "ok" if good else "fail", f"{platform.python_version()} (3.11 or newer is needed)"
    )


def _cores() -> Finding:
    cores = health.processors()
    good = cores >= _LEAST_CORES
    return Finding("processors", "ok" if good else "warn", f"{cores} usable; the times in docs/ are for 2")


def _memory(budget_mb: int) -> Finding:
    available = health.available_memory_mb()
    if available == 0.0:
        return Finding("memory", "warn", "this system does not say how much memory is free")
    enough = available > budget_mb
    detail = f"{available:.0f} MB free for a budget of {budget_mb} MB (voxel_map.memory_budget_mb)"
    return Finding("memory", "ok" if enough else "warn", detail)


def _disk() -> Finding:
    free = health.free_disk_mb(Path.cwd())
    return Finding("disk", "ok" if free > _LEAST_DISK_MB else "warn", f"{free:.0f} MB free in {Path.cwd()}")


def _configuration(file: Path | None) -> tuple[config.Config, Finding]:
    try:
        settings = config.load(file)
    except UserError as error:
        return config.Config(), Finding("configuration", "fail", str(error))
    return settings, Finding("configuration", "ok", "defaults" if file is None else f"{file} is valid")


def _kernels() -> Finding:
    import numpy as np

    from artemis_edge._jit import cache_dir
    from artemis_edge.render import depth_map, from_above

    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    view = from_above(np.zeros(3), np.ones(3), 0.25, cull=False)
    depth = depth_map(view, corners, np.array([[0, 1, 2]], np.int32))
    good = bool(np.isfinite(depth).any())
    detail = f"compiled code works, kept in {cache_dir()}" if good else "compiled code gives wrong results"
    return Finding("kernels", "ok" if good else "fail", detail)


def _bags() -> Finding:
    from importlib.util import find_spec

    if find_spec("rosbags") is None:
        return Finding("ROS 1", "warn", "bags of ROS 1 need the extra: pip install 'artemis-edge[import]'")
    return Finding("ROS 1", "ok", "bags of ROS 1 can be read")
