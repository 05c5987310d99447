"""Command line ``dvo``: parsing of options and printing of errors; :mod:`dvo.commands` implements the commands.

Heavy modules are imported only for the command in use, so that ``dvo --help`` is fast.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from types import FrameType
from typing import NoReturn

from dvo import __version__
from dvo.commands import BAD_INPUT, HUNG_UP, INTERRUPTED, OK, TERMINATED, Terminated, ending_signals
from dvo.commands.calibrate_options import add_calibrate
from dvo.commands.imu_options import add_imu
from dvo.commands.kernels import compiled_meanwhile
from dvo.commands.run_options import (
    add_batch_options,
    add_folder_options,
    add_image_options,
    add_run_options,
    add_tracking_options,
)
from dvo.commands.stream_options import add_stream_options
from dvo.core.command_line import OneLineParser, positive_float, positive_int, seed, whole
from dvo.core.errors import DvoError
from dvo.core.limits import LOADING, TRACKING, check_limits, limit_error
from dvo.core.text import print_line, print_traceback

EXIT_CODES = (
    "exit codes: 0 done, 1 no frame could be tracked, 2 bad input or results that cannot be written, 129 hung up, "
    "130 interrupted, 143 terminated (results so far are written)"
)

_TRACKING = ("demo", "run", "calibrate")  # commands
_BATCH_CODES = (
    "exit codes: 0 all videos are tracked, 1 one of them failed or has no tracked frame, 2 bad usage, 129 hung up, "
    "130 interrupted, 143 terminated (the same command goes on)"
)
_MERGE_CODES = "exit codes: 0 done, 1 the second map was not recognised in the first (nothing is written), 2 bad input"


def build_parser() -> argparse.ArgumentParser:
    """Build the command line.

    Returns:
        The parser; the default ``run`` of each command is ``"module:function"``, called with the parsed arguments.
    """
    parser = OneLineParser(prog="dvo", description="Learned monocular visual odometry.", epilog=EXIT_CODES)
    parser.add_argument("--version", action="version", version=f"dvo {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    demo = commands.add_parser("demo", help="render a clip, track it and compare with the ground truth")
    add_folder_options(demo)
    add_tracking_options(demo)
    demo.add_argument("--frames", type=positive_int, default=60, help="length of the clip (default: %(default)s)")
    demo.set_defaults(run="dvo.demo:demo")

    run = commands.add_parser("run", help="track a video, a folder of images or a dataset sequence", epilog=EXIT_CODES)
    run.add_argument(
        "source",
        metavar="SOURCE",
        help="video, images, dataset sequence, webcam:0, rtsp://..., http://... or -",
    )
    add_folder_options(run)
    add_run_options(run)
    add_stream_options(run)
    run.set_defaults(run="dvo.commands.run:run")

    batch = commands.add_parser(
        "batch", help="track many videos, a results folder for each, and a table of all", epilog=_BATCH_CODES
    )
    add_batch_options(batch)
    batch.set_defaults(run="dvo.commands.batch:batch")

    add_calibrate(commands)

    summary = commands.add_parser("summary", help="write the page summary.html of a results folder anew")
    summary.add_argument("source", metavar="RESULTS", help="results folder of dvo run or dvo demo")
    summary.add_argument("--groundtruth", metavar="FILE", help="TUM trajectory (camera to world) to compare with")
    summary.add_argument("--out", metavar="FILE", help="file to write (default: RESULTS/summary.html)")
    summary.set_defaults(run="dvo.commands.summary:summary")

    evaluate = commands.add_parser("evaluate", help="compare trajectories with a reference, without a run")
    evaluate.add_argument(
        "reference",
        metavar="REFERENCE",
        help="ground truth (TUM, KITTI, EuRoC or TartanAir), the folder of a data set, or a results folder",
    )
    evaluate.add_argument(
        "estimates", metavar="ESTIMATE", nargs="+", help="trajectories in these formats, or results folders"
    )
    evaluate.add_argument(
        "--align", choices=("sim3", "se3", "scale", "none"), default="sim3", help="fitted first (default: %(default)s)"
    )
    evaluate.add_argument(
        "--max-dt",
        type=positive_float,
        default=0.01,
        metavar="S",
        help="largest difference of matched times in seconds (default: %(default)s)",
    )
    evaluate.add_argument("--out", metavar="FILE", help="picture of all of them, .png, .pdf, .svg or .jpg")
    evaluate.set_defaults(run="dvo.commands.evaluate:evaluate")

    merge = commands.add_parser("merge", help="join two maps of one place", epilog=_MERGE_CODES)
    merge.add_argument("first", metavar="FIRST", help="map file (.dvo), which keeps its world and scale")
    merge.add_argument("second", metavar="SECOND", help="map file (.dvo) of a single recording")
    merge.add_argument("--out", "-o", metavar="FILE", required=True, help="map file to write")
    merge.add_argument("--device", metavar="D", default="auto", help="torch device (default: accelerator if available)")
    merge.set_defaults(run="dvo.commands.maps:merge")

    export = commands.add_parser("export", help="write a results folder or a map for another program")
    export.add_argument("source", metavar="SOURCE", help="results folder of dvo run or dvo demo, or map file (.dvo)")
    export.add_argument("out", metavar="OUT", help="new folder; of several formats, one in it for each")
    export.add_argument(
        "--to",
        metavar="NAMES",
        required=True,
        help="tum, kitti, euroc, colmap, colmap-text or nerfstudio; several apart by commas",
    )
    export.add_argument("--segment", type=_count, metavar="N", help="number of the segment (default: the longest)")
    add_image_options(export)
    export.set_defaults(run="dvo.commands.export:export")

    weights = commands.add_parser("weights", help="list, import, export or describe weights")
    verbs = weights.add_subparsers(dest="verb", required=True, metavar="VERB")
    verbs.add_parser("list", help="weights that ship with dvo").set_defaults(run="dvo.commands.weights:list_shipped")
    importer = verbs.add_parser(
        "import", help="convert a published checkpoint of DPVO, DROID-SLAM or TartanVO to safetensors"
    )
    importer.add_argument(
        "file", metavar="FILE", help="dpvo.pth, droid.pth, or tartanvo_1914.pkl (not tried with the real file)"
    )
    importer.add_argument("--out", metavar="FILE", help="safetensors file to write (default: FILE's name, here)")
    importer.set_defaults(run="dvo.commands.weights:import_file")
    onnx = verbs.add_parser("onnx", help="write the encoder as an ONNX file (extra onnx)")
    onnx.add_argument("weights", metavar="NAME|FILE")
    onnx.add_argument("--out", metavar="FILE", help="file to write (default: NAME-encoder.onnx)")
    onnx.set_defaults(run="dvo.commands.weights:export_onnx")
    info = verbs.add_parser("info", help="architecture, size and origin of weights")
    info.add_argument("weights", metavar="NAME|FILE")
    info.set_defaults(run="dvo.commands.weights:info")

    synth = commands.add_parser("synth", help="render scenes and meshes: preview them, or write sequences")
    verbs = synth.add_subparsers(dest="verb", required=True, metavar="VERB")
    preview = verbs.add_parser("preview", help="write a contact sheet of frames, depth, flow and path")
    preview.add_argument(
        "source",
        metavar="SOURCE",
        nargs="?",
        help="family, mesh file (glTF, OBJ, PLY), or 'clips'; default: all families",
    )
    preview.add_argument("--out", metavar="FILE", required=True, help="PNG to write")
    preview.add_argument("--rows", type=_rows, metavar="N", help="rows of a family, mesh or 'clips'")
    _rendering_options(preview, "160x120")
    preview.set_defaults(run="dvo.commands.synth:preview")
    export = verbs.add_parser("export", help="write a sequence with ground truth in the layout of a dataset")
    export.add_argument("--layout", choices=("tum", "tartanair", "euroc"), default="tum", help="default: %(default)s")
    export.add_argument(
        "--imu-noise",
        choices=("euroc", "phone", "action", "none"),
        default="euroc",
        help="of the inertial samples in the layout euroc (default: %(default)s)",
    )
    export.add_argument("--out", metavar="DIR", required=True, help="new folder")
    content = export.add_mutually_exclusive_group()
    content.add_argument("--family", metavar="F", help="family of scenes (default: random)")
    content.add_argument("--mesh", metavar="FILE", help="glTF, OBJ or PLY file to render, from inside or outside")
    export.add_argument("--frames", type=positive_int, default=150, metavar="N", help="default: %(default)s")
    export.add_argument("--fps", type=positive_float, default=30.0, metavar="F", help="default: %(default)g")
    export.add_argument("--path", metavar="KIND", help="kind of path: handheld, forward, orbit, rotation, drone, ...")
    export.add_argument("--sensor", action="store_true", help="simulate noise, vignetting and other sensor effects")
    export.add_argument(
        "--lens", choices=("none", "radtan", "fisheye"), default="none", help="distortion (default: %(default)s)"
    )
    export.add_argument("--device", metavar="D", default="cpu", help="torch device (default: %(default)s)")
    _rendering_options(export, "320x240")
    export.set_defaults(run="dvo.commands.synth:export")

    add_imu(commands)

    doctor = commands.add_parser("doctor", help="report versions, devices, threads, codecs, weights, gaps")
    doctor.add_argument("--json", action="store_true", help="print JSON, for bug reports")
    doctor.set_defaults(run="dvo.commands.doctor:doctor")
    return parser


def _rendering_options(parser: argparse.ArgumentParser, size: str) -> None:
    parser.add_argument("--size", type=_size, default=_size(size), metavar="WxH", help=f"pixels (default: {size})")
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="default: %(default)s")
    parser.add_argument("--textures", metavar="DIR", help="folder of photographs for the textures of the scenes")
    parser.add_argument("--up", choices=("y", "z"), help="axis of the mesh that points up (default: y; z for PLY)")
    parser.add_argument(
        "--view",
        choices=("auto", "inside", "outside"),
        default="auto",
        help="position of the camera: inside or outside the mesh",
    )
    parser.add_argument(
        "--unlit", action="store_true", help="render without shading, for textures that contain the lighting"
    )


def _count(text: str) -> int:
    value = whole(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"must be 0 or more, got {text[:60]}")
    return value


def _size(text: str) -> tuple[int, int]:
    width, separator, height = text.lower().partition("x")
    digits = all(part.isdecimal() and len(part) < 6 for part in (width, height))
    if not (separator and digits and all(16 <= int(part) <= 8192 for part in (width, height))):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT from 16 to 8192 pixels, got {text[:60]!r}")
    return int(width), int(height)


def _rows(text: str) -> int:
    value = positive_int(text)
    if value > 1000:
        raise argparse.ArgumentTypeError(f"must be 1000 or less, got {text[:60]}")
    return value


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command. Invalid input and every failure of the system (``OSError``) end in one line on stderr.

    Args:
        argv: arguments without the program's name; None for those of the process.

    Returns:
        Exit code, see :mod:`dvo.commands`.
    """
    os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")  # images that do not decode are counted, and told once
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it speaks of a home that cannot be written
    with _terminable() as received:
        code = _run(argv, received)
    code = _flush(code)
    if argv is None and code == TERMINATED:  # a thread may be in the midst of work that nobody waits for any more
        os._exit(code)
    return code


def _run(argv: Sequence[str] | None, received: Sequence[KeyboardInterrupt]) -> int:
    try:
        if not _has_folder():
            message, remedy = "the working directory is gone", "change to one that exists (cd)"
            return _complain(DvoError(message, remedy=remedy), BAD_INPUT)
        arguments = build_parser().parse_args(argv)
        is_tracking = arguments.command in _TRACKING
        check_limits(TRACKING if is_tracking else LOADING)
        # The process of a program, and not a call from one, may have another process beside it.
        with compiled_meanwhile(arguments) if is_tracking and argv is None else contextlib.nullcontext():
            module, function = arguments.run.split(":")
            command: Callable[[argparse.Namespace], int] = getattr(import_module(module), function)
            return command(arguments)
    except SystemExit as exit_:  # argparse: --help, --version, or a wrong option
        return exit_.code if isinstance(exit_.code, int) else BAD_INPUT
    except (Exception, KeyboardInterrupt) as error:
        # A library may turn the exception of a signal into one of its own.
        return _failed(received[-1] if received else error)


def _has_folder() -> bool:
    """False in a deleted working directory, where libraries end the process with lines of their own."""
    try:
        return bool(os.getcwd())
    except OSError:
        return False


def _failed(error: Exception | KeyboardInterrupt) -> int:
    """Print a line for what has ended a command, and return the exit code; errors of this program are raised."""
    if isinstance(error, Terminated):
        return _complain("hung up" if error.code == HUNG_UP else "terminated", error.code)
    if isinstance(error, KeyboardInterrupt):
        return _complain("interrupted", INTERRUPTED)
    if isinstance(error, BrokenPipeError):  # the reader of stdout has seen enough
        return OK
    if isinstance(error, OSError):
        error = _as_input_error(error)
    known = error if isinstance(error, DvoError) else limit_error(error)
    if known is not None:
        return _complain(known, BAD_INPUT)
    sys.excepthook = print_traceback  # it may quote names and addresses too
    raise error


@contextlib.contextmanager
def _terminable() -> Iterator[list[KeyboardInterrupt]]:
    """Raise :class:`Terminated` at SIGTERM and SIGHUP, so that a command can clean up; unless they are handled.

    Yields:
        What was raised so far, also at Ctrl-C.
    """
    received: list[KeyboardInterrupt] = []

    def end(number: int, frame: FrameType | None) -> NoReturn:
        received.append(KeyboardInterrupt() if number == signal.SIGINT else Terminated(number))
        raise received[-1]

    is_main = threading.current_thread() is threading.main_thread()
    usual = (signal.SIG_DFL, signal.default_int_handler)
    numbers = (signal.SIGINT, *ending_signals()) if is_main else ()
    before = {number: handler for number in numbers if (handler := signal.getsignal(number)) in usual}
    for number in before:
        signal.signal(number, end)
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _as_input_error(error: OSError) -> DvoError:
    return DvoError(error.strerror or str(error) or type(error).__name__, file=error.filename)


def _complain(problem: DvoError | str, code: int) -> int:
    """Print a line to stderr, if it can be written, and return the exit code."""
    text = problem if isinstance(problem, str) else f"error: {' '.join(str(problem).split())}"
    with contextlib.suppress(OSError):
        print_line(f"dvo: {text}", error=True)
    return code


def _flush(code: int) -> int:
    """Flush both streams; one that cannot be written is replaced, because the interpreter flushes it again at exit."""
    for stream in (sys.stdout, sys.stderr):
        try:
            if stream is not None and not stream.closed:
                stream.flush()
        except OSError as error:
            with contextlib.suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
            if stream is sys.stdout and code != BAD_INPUT and not isinstance(error, BrokenPipeError):
                code = _complain(DvoError(error.strerror or str(error), file="standard output"), code or BAD_INPUT)
    return code


if __name__ == "__main__":
    sys.exit(main())
