"""The command line: what can be asked, and how errors are told. Other modules do the work."""

from __future__ import annotations

import argparse
import errno
import io
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from artemis_edge.commands import (
    calibrate,
    georeference,
    models,
    output,
    replay,
    rig,
    run,
    semantics,
    session,
    texture,
    tui,
    view,
    warm_up,
)
from artemis_edge.commands.common import BAD_USE, DONE, FELL_SHORT, Handler, command, json_option, print_json
from artemis_edge.errors import InputError, UserError

DEMO_OUT = Path("demo-out")
_INTERRUPTED = "artemis-edge: interrupted; complete results are kept, nothing half-written is left"
_OUT_OF_MEMORY = "artemis-edge: not enough memory; close other programs or lower voxel_map.memory_budget_mb"
_DEMO_SECONDS, _SIMULATED_SECONDS, _SEED = 12.0, 20.0, 1


class _UsageError(Exception):
    """A command line that does not parse, as a line for the user."""


class _Parser(argparse.ArgumentParser):
    """Usage errors are one line and say where help is."""

    def error(self, message: str) -> NoReturn:
        raise _UsageError(f"{self.prog}: {message}; see '{self.prog} --help'")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code: 0 done, 1 ran and failed or fell short, 2 bad use or input.

    With ``--json`` stdout has one object in any case: the result, or ``error`` (the sentence) and ``exit_code``.
    """
    words = sys.argv[1:] if arguments is None else arguments
    _write_anything()
    try:
        given = _parser().parse_args(words)
        handler: Handler = given.handler
        code = handler(given)
        sys.stdout.flush()
        return code
    except SystemExit as ending:  # argparse, after help
        return ending.code if isinstance(ending.code, int) else BAD_USE
    except BrokenPipeError:
        # Whoever read our output has left; Python must not try to flush it again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FELL_SHORT
    except Exception as error:
        line, code = _line(error)
        return _tell(line, code, "--json" in words)
    except KeyboardInterrupt:
        return _tell(_INTERRUPTED, FELL_SHORT, "--json" in words)


def _write_anything() -> None:
    """File names and questions may hold what the terminal's encoding lacks."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def _line(error: Exception) -> tuple[str, int]:
    """What to print and the exit code; what is no fault of user or machine is raised."""
    match error:
        case _UsageError():
            return str(error), BAD_USE
        case UserError():
            return f"artemis-edge: {error}", error.exit_code
        case MemoryError():
            return _OUT_OF_MEMORY, FELL_SHORT
        case OSError():
            return f"artemis-edge: {_os_sentence(error)}", FELL_SHORT
        case SystemError() if _interrupted(error):
            return _INTERRUPTED, FELL_SHORT
    raise error


def _interrupted(error: BaseException | None) -> bool:
    """Whether an interrupt is behind it: inside a compiled kernel Python wraps it in a SystemError."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _tell(line: str, code: int, json: bool) -> int:
    print(line, file=sys.stderr)
    if json:
        print_json({"error": line.partition(": ")[2], "exit_code": code})
    return code


def _os_sentence(error: OSError) -> str:
    what = f"{error.filename}: " if error.filename else ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"{what}the disk is full; free space or choose another place"
    return f"{what}{error.strerror or error}; check that it is there and that you may use it"


# --- the grammar


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="artemis-edge",
        description="LiDAR, camera and IMU mapping: from scans to a triangle mesh.",
        epilog="'artemis-edge COMMAND --help' explains a command; docs/operator.md tells how it is used.",
    )
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for add in (
        _demo,
        _simulate,
        _reprocess,
        _evaluate,
        _bench,
        output.add_render,
        output.add_export,
        view.add,
        semantics.add_ask,
        _check,
        session.add,
        replay.add,
        run.add,
        warm_up.add,
        models.add,
        rig.add,
        calibrate.add,
        georeference.add,
        tui.add,
    ):
        add(commands)
    return parser


def _version() -> str:
    from importlib import metadata

    return f"artemis-edge {metadata.version('artemis-edge')}"


def _config_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--profile", metavar="NAME", help="a set of settings that ships with the program")
    parser.add_argument(
        "--set", metavar="SECTION.FIELD=VALUE", action="append", default=[], dest="sets",
        help="one setting (docs/tuning.md lists them); may be repeated",
    )  # fmt: skip


def _demo(commands: Any) -> None:
    parser = command(commands, "demo", run_demo, "walk through a virtual world, map it, measure the map")
    parser.add_argument("--world", default="street", metavar="NAME", help="as of simulate (default: street)")
    parser.add_argument(
        "--seconds", type=float, default=_DEMO_SECONDS, help="length of the walk (default: 12)"
    )
    parser.add_argument("--out", type=Path, default=DEMO_OUT, metavar="DIR", help="default: ./demo-out")
    parser.add_argument(
        "--query", action="append", default=[], metavar="TEXT", help="what to look for; may be repeated"
    )
    parser.add_argument(
        "--tui",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="watch the mesh grow in the terminal",
    )


def _simulate(commands: Any) -> None:
    parser = command(
        commands, "simulate", run_simulate, "record a session in a virtual world, with its truth"
    )
    parser.add_argument(
        "world",
        metavar="WORLD",
        help="street, courtyard, hall, corridor, facade, bench, or a .glb, .gltf or .obj file",
    )
    parser.add_argument("--seed", type=int, default=_SEED, help="which of its variants (default: 1)")
    parser.add_argument("--seconds", type=float, default=_SIMULATED_SECONDS, help="length (default: 20)")
    parser.add_argument("--lidar", default="avia", help="avia, mid360 or hdl64 (default: avia)")
    parser.add_argument(
        "--set", metavar="KEY=VALUE", action="append", default=[], dest="sets",
        help="one setting (docs/virtual-rig.md lists them); may be repeated",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, required=True, metavar="SESSION", help="folder to write")


def _reprocess(commands: Any) -> None:
    parser = command(
        commands, "reprocess", run_reprocess, "map recordings: from an input to a mesh and report"
    )
    parser.add_argument(
        "inputs", nargs="+", type=Path, metavar="INPUT",
        help="a session, a ROS 1 or ROS 2 bag, a KITTI odometry sequence or a KITTI raw drive",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    poses = parser.add_mutually_exclusive_group()
    poses.add_argument("--poses", type=Path, metavar="FILE.tum", help="poses to map with")
    poses.add_argument(
        "--no-poses", action="store_true", help="estimate the poses even where the input has some"
    )
    _config_options(parser)
    parser.add_argument(
        "--frames", type=_span, default=(0, None), metavar="A:B", help="frames A <= k < B only"
    )
    parser.add_argument(
        "--holdout", type=_at_least_two, default=0, metavar="N",
        help="keep every N-th photograph of each camera out of the map and write it to PHOTOS.json",
    )  # fmt: skip
    parser.add_argument(
        "--query",
        action="append",
        default=[],
        metavar="TEXT",
        help="what to find, for example 'red car'; may be repeated",
    )
    parser.add_argument(
        "--dynamic-filter",
        action="store_true",
        help="leave out what moved; it is kept apart in map/removed.ply",
    )
    parser.add_argument(
        "--model", default="", metavar="NAME", help="network that looks for it ('models list')"
    )
    parser.add_argument(
        "--continue", type=Path, metavar="MAP", dest="go_on",
        help="recognise the place in a map made before and extend that map, in its frame",
    )  # fmt: skip
    parser.add_argument(
        "--jobs", type=_at_least_one, metavar="N",
        help="of several inputs, how many are mapped at a time (default: what cores and memory allow)",
    )  # fmt: skip
    parser.add_argument(
        "--cluster", default="", metavar="ADDRESS",
        help="map on the workers of a Dask cluster, for example tcp://10.0.0.5:8786 (extra 'cluster')",
    )  # fmt: skip
    json_option(parser)


def _evaluate(commands: Any) -> None:
    group = commands.add_parser("evaluate", help="measure a mesh or a trajectory against a reference")
    kinds = group.add_subparsers(title="kinds", metavar="KIND", required=True)
    mesh = command(kinds, "mesh", run_evaluate_mesh, "a mesh against a reference cloud")
    mesh.add_argument("mesh", type=Path, metavar="MESH", help="an output directory or a mesh.ply")
    mesh.add_argument("--reference", type=Path, required=True, metavar="CLOUD.ply")
    mesh.add_argument("--threshold", type=float, action="append", metavar="METRES", help="default: 0.1")
    mesh.add_argument("--crop", action="store_true", help="leave out the mesh outside the reference's box")
    mesh.add_argument("--heatmap", type=Path, metavar="FILE.png", help="precision and recall from above")
    json_option(mesh)
    texture.add(kinds)
    semantics.add_evaluate(kinds)
    path = command(kinds, "trajectory", run_evaluate_trajectory, "a trajectory against a reference")
    path.add_argument("estimate", type=Path, metavar="ESTIMATE.tum")
    path.add_argument("--reference", type=Path, required=True, metavar="REF.tum")
    json_option(path)


def _bench(commands: Any) -> None:
    parser = command(commands, "bench", run_bench, "measure what a frame costs on this machine")
    parser.add_argument("input", nargs="?", type=Path, metavar="INPUT", help="default: a virtual Avia walk")
    parser.add_argument(
        "--frames", type=int, default=100, metavar="N", help="at most N frames (default: 100)"
    )
    _config_options(parser)
    json_option(parser)


def _check(commands: Any) -> None:
    parser = command(commands, "check", run_check, "see whether this machine is ready")
    parser.add_argument("--config", type=Path, metavar="FILE", help="a configuration to check as well")
    json_option(parser)


def _span(text: str) -> tuple[int, int | None]:
    first, colon, last = text.partition(":")
    try:
        start, stop = int(first or 0), int(last) if last else None
    except ValueError:
        colon, start, stop = "", 0, None
    if not colon or start < 0 or (stop is not None and stop <= start):
        raise argparse.ArgumentTypeError(f"'{text}' is not A:B with 0 <= A < B, for example 0:100")
    return start, stop


def _at_least_one(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of 1 or more")
    return int(text)


def _at_least_two(text: str) -> int:
    if not text.isdecimal() or int(text) < 2:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of 2 or more")
    return int(text)


# --- the commands


def run_demo(given: argparse.Namespace) -> int:
    """``artemis-edge demo``."""
    from artemis_edge.session.demo import QUERIES, demo

    if given.tui:
        return tui.run_demo(given, _SEED)
    print(demo(given.world, given.seconds, _SEED, given.out, queries=given.query or QUERIES))
    return DONE


def run_simulate(given: argparse.Namespace) -> int:
    """``artemis-edge simulate``."""
    from artemis_edge.progress import progress, say
    from artemis_edge.session.results import preparing
    from artemis_edge.session.simulate import simulate

    settings = dict(_key_value(text) for text in given.sets)
    with preparing(given.out), progress("simulating") as report:
        made = simulate(given.world, given.seed, given.seconds, given.lidar, given.out, settings, report)
    for note in made.notes:
        say(f"note: {note}")
    print(f"{made.session}: {made.frames} frames, {made.points} points, {made.images} photographs")
    print(f"{made.truth}: truth of a walk of {made.length_m:.1f} m")
    return DONE


def _key_value(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise InputError(f"--set {text}: write it as key=value")
    return key, value


def run_reprocess(given: argparse.Namespace) -> int:
    """``artemis-edge reprocess``."""
    from artemis_edge import batch, config
    from artemis_edge.runtime import Request

    if given.model and not given.query:
        raise InputError(
            f"--model {given.model} looks for nothing without a question; give --query TEXT as well"
        )
    start, stop = given.frames
    moved = ["voxel_map.dynamic_filter=true"] if given.dynamic_filter else []
    outcomes = batch.run_all(
        [
            Request(
                path,
                out,
                settings,
                given.poses,
                given.no_poses,
                start,
                stop,
                given.holdout,
                tuple(given.query),
                given.model,
                given.go_on,
            )
            for settings in [config.load(profile=given.profile, sets=[*given.sets, *moved])]
            for path, out in batch.places(given.inputs, given.out)
        ],
        plain=given.json,
        jobs=given.jobs,
        cluster=given.cluster,
    )
    reports = {str(outcome.out): outcome.report for outcome in outcomes}
    if given.json:
        print_json(next(iter(reports.values())) if len(given.inputs) == 1 else {"runs": reports})
    else:
        for outcome in outcomes:
            print(batch.summary(outcome))
    return DONE


def run_evaluate_mesh(given: argparse.Namespace) -> int:
    """``artemis-edge evaluate mesh``."""
    from artemis_edge.evaluate import mesh
    from artemis_edge.export.places import check_file
    from artemis_edge.export.ply import find_mesh

    thresholds = given.threshold or mesh.DEFAULT_THRESHOLDS
    if given.heatmap is not None:
        check_file("--heatmap", given.heatmap, (".png",), (find_mesh(given.mesh), given.reference))
    result = mesh.run(find_mesh(given.mesh), given.reference, thresholds, given.crop)
    if given.heatmap is not None:
        from artemis_edge.session.pictures import write_heat_maps

        write_heat_maps(given.heatmap, result)
    if given.json:
        print_json(result.to_json())
    else:
        print(mesh.to_text(result))
    return DONE


def run_evaluate_trajectory(given: argparse.Namespace) -> int:
    """``artemis-edge evaluate trajectory``."""
    from artemis_edge.evaluate import trajectory

    result = trajectory.run(given.estimate, given.reference)
    if given.json:
        print_json(result.to_json())
    else:
        print(trajectory.to_text(result))
    return DONE


def run_bench(given: argparse.Namespace) -> int:
    """``artemis-edge bench``."""
    from artemis_edge import bench, config

    if given.frames < 1:
        raise InputError(f"--frames {given.frames}: give 1 or more")
    settings = config.load(profile=given.profile, sets=given.sets)
    result = bench.bench(given.input, given.frames, settings, plain=given.json)
    if given.json:
        print_json(result)
    else:
        print(bench.to_text(result))
    return DONE


def run_check(given: argparse.Namespace) -> int:
    """``artemis-edge check``."""
    from artemis_edge import check

    findings = check.check(given.config)
    if given.json:
        print_json(check.to_json(findings))
    else:
        print(check.to_text(findings))
    return DONE if check.ready(findings) else FELL_SHORT


if __name__ == "__main__":
    sys.exit(main())
