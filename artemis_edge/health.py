"""What the machine has left: memory, processors, disk. Whoever asks decides what is enough."""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import threading
from dataclasses import dataclass
from pathlib import Path

MB = 1e6
_KIB = 1024.0
_NS = 1e9
_RESET_PEAK = "5"  # proc(5), /proc/pid/clear_refs


def resident_mb() -> float:
    """Resident memory of this process now, MB of 1e6 bytes; 0 where the system does not say."""
    return _proc_field(Path("/proc/self/status"), "VmRSS:")


def restart_peak() -> None:
    """Measure the peak of resident memory from here on, where the system can."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text(_RESET_PEAK)


def peak_resident_mb() -> float:
    """Largest resident memory since ``restart_peak`` (or ever), MB; 0 where the system does not say."""
    return _proc_field(Path("/proc/self/status"), "VmHWM:")


def give_back_memory() -> None:
    """Return freed memory to the system, which glibc keeps else: 84 MB after a 20-minute recording is opened."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def cpu_by_thread_s() -> dict[str, float]:
    """CPU time so far of every thread of this process that Python knows, by name; empty where it is not told."""
    found: dict[str, float] = {}
    for thread in threading.enumerate():
        with contextlib.suppress(OSError, ValueError):
            spent_ns = Path(f"/proc/self/task/{thread.native_id}/schedstat").read_text().split()[0]
            found[thread.name] = found.get(thread.name, 0.0) + int(spent_ns) / _NS
    return found


def available_memory_mb() -> float:
    """Memory that new work can take without swapping, MB; 0 where the system does not say."""
    return _proc_field(Path("/proc/meminfo"), "MemAvailable:")


def processors() -> int:
    """Processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def free_disk_mb(folder: Path) -> float:
    """Free space in the file system of ``folder`` or of its nearest parent that exists, MB."""
    place = folder.resolve()
    while not place.exists():
        place = place.parent
    return shutil.disk_usage(place).free / MB


@dataclass(frozen=True, slots=True)
class Battery:
    """``percent`` left, ``minutes`` at this load where the system tells the flow; ``charging`` or full at a supply."""

    percent: float
    minutes: float | None
    charging: bool


def battery(folder: Path = Path("/sys/class/power_supply")) -> Battery | None:
    """The first battery that the system knows of."""
    for supply in sorted(folder.glob("*")):
        with contextlib.suppress(OSError, ValueError):
            if (supply / "type").read_text().strip() == "Battery":
                percent = float((supply / "capacity").read_text())
                return Battery(percent, _minutes(supply), _status(supply) in ("Charging", "Full"))
    return None


def _status(supply: Path) -> str:
    with contextlib.suppress(OSError):
        return (supply / "status").read_text().strip()
    return ""


def _minutes(supply: Path) -> float | None:
    for now, flow in (("energy_now", "power_now"), ("charge_now", "current_now")):
        with contextlib.suppress(OSError, ValueError):
            drain = abs(int((supply / flow).read_text()))
            return int((supply / now).read_text()) / drain * 60 if drain else None
    return None


def temperature_c(folder: Path = Path("/sys/class/thermal")) -> float | None:
    """The hottest place that the kernel knows of, degrees Celsius; None where it tells of none."""
    readings = []
    for zone in folder.glob("thermal_zone*/temp"):
        with contextlib.suppress(OSError, ValueError):
            readings.append(int(zone.read_text()) / 1000)
    return max(readings, default=None)


def _proc_field(file: Path, name: str) -> float:
    """A field of /proc given in kB (there: of 1024 bytes), in MB."""
    try:
        lines = file.read_text().splitlines()
    except OSError:
        return 0.0
    for line in lines:
        if line.startswith(name):
            return float(line.split()[1]) * _KIB / MB
    return 0.0
