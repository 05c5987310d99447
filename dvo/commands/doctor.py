"""``dvo doctor``: what this installation consists of, what works, and what is missing.

Each section is computed on its own, and a part that fails becomes a line of the report: the command has to work on an
installation that does not.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import json
import os
import platform
import shutil
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from dvo.commands.probes import (
    arithmetic_state,
    checksum_state,
    image_works,
    processor_name,
    sentence_of,
    version_of,
    video_state,
)  # fmt: skip
from dvo.core.text import print_line

Section = dict[str, str]

# Distribution and module of the packages that dvo needs.
REQUIRED = (
    ("torch", "torch"), ("numpy", "numpy"), ("opencv-python-headless", "cv2"), ("numba", "numba"),
    ("jaxtyping", "jaxtyping"), ("safetensors", "safetensors"), ("pyyaml", "yaml"), ("rich", "rich"),
    ("matplotlib", "matplotlib"),
)  # fmt: skip

# Distribution, module and use of optional packages; the way to install them, where it is not "pip install NAME".
OPTIONAL = (
    ("scikit-image", "skimage", "photographs as textures, training", ""),
    ("trimesh", "trimesh", "meshes (dvo synth)", ""),
    ("pillow", "PIL", "textures of meshes", ""),
    ("rerun-sdk", "rerun", "viewer", ""),
    ("rosbags", "rosbags", "ROS bags", ""),
    ("lightning", "lightning", "training", ""),
    ("imageio-ffmpeg", "imageio_ffmpeg", "training, renderings as H.264", ""),
    ("kornia", "kornia", "training", ""),
    ("tensorboard", "tensorboard", "curves of training", ""),
    ("jsonargparse", "jsonargparse", "training", "pip install 'jsonargparse[signatures]'"),
    ("evo", "evo", "metrics of the evaluation", ""),
    ("scipy", "scipy", "evaluation", ""),
    ("jinja2", "jinja2", "report of the evaluation", ""),
    ("ray", "ray", "evaluation on a cluster", ""),
    ("open3d", "open3d", "mesh of depth images (--tsdf)", ""),
    ("onnx", "onnx", "encoder as ONNX (dvo weights onnx)", ""),
    ("onnxruntime", "onnxruntime", "encoder as ONNX (dvo weights onnx)", ""),
    ("mkdocs-material", "material", "documentation site", ""),
    ("mkdocstrings", "mkdocstrings", "documentation site", "pip install 'mkdocstrings[python]'"),
    ("ziamath", "ziamath", "documentation site", ""),
    ("pycolmap", "pycolmap", "peer COLMAP", ""),
    ("pyorbslam3", "pyorbslam3", "peer ORB-SLAM3", "pip install pyorbslam3 (Linux x86-64)"),
    ("svo-cpp", "svo_cpp", "peer SVO", "pip install --no-deps svo-cpp"),
    ("ros-rclpy", "rclpy", "node of ROS 2", "pip install 'dvo[ros2]' (Python 3.11, Linux x86-64)"),
    ("ros-nav-msgs", "nav_msgs", "node of ROS 2", "pip install 'dvo[ros2]' (Python 3.11, Linux x86-64)"),
    ("ros-sensor-msgs", "sensor_msgs", "node of ROS 2", "pip install 'dvo[ros2]' (Python 3.11, Linux x86-64)"),
    ("ros-diagnostic-msgs", "diagnostic_msgs", "node of ROS 2", "pip install 'dvo[ros2]' (Python 3.11, Linux x86-64)"),
    ("ros-std-srvs", "std_srvs", "node of ROS 2", "pip install 'dvo[ros2]' (Python 3.11, Linux x86-64)"),
)

GROUPS = ("dvo.architectures", "dvo.odometries", "dvo.readers", "dvo.scene_families", "dvo.systems", "dvo.tasks")

# Name, code and suffix of the videos that are written and read back.
_VIDEOS = (("MPEG-4 in mp4", "mp4v", ".mp4"), ("Motion JPEG in avi", "MJPG", ".avi"))
_IMAGES = (".png", ".jpg", ".tiff", ".webp", ".bmp", ".ppm")
_MISSING = "missing"
_AGAIN = "Try: pip install --force-reinstall"


def doctor(arguments: argparse.Namespace) -> int:
    """Entry point of ``dvo doctor``.

    Args:
        arguments: of the command line; ``json`` prints JSON.

    Returns:
        0, also if there are problems: they are listed.
    """
    report, problems = diagnose()
    if arguments.json:
        print_line(json.dumps({**report, "problems": problems}, indent=2), lines=True)
        return 0
    for title, section in report.items():
        print_line(title)
        width = max(map(len, section), default=0)
        for name, value in section.items():
            print_line(f"  {name:<{width}}  {value}".rstrip())
        print_line()
    print_line("problems:" if problems else "problems: none")
    for problem in problems:
        print_line(f"  - {problem}")
    return 0


def diagnose() -> tuple[dict[str, Section], list[str]]:
    """Examine the installation.

    Returns:
        Title to section, a section being name to value; and the problems, a sentence each with its remedy.
    """
    sections: dict[str, Callable[[list[str]], Section]] = {
        "versions": versions,
        "devices": devices,
        "threads": threads,
        "video and images": codecs,
        "weights": weights,
        "folders": folders,
        "optional packages": optional_packages,
        "registered by packages": registered,
    }
    problems: list[str] = []
    report = {}
    for title, examine in sections.items():
        try:
            report[title] = examine(problems)
        except Exception as error:  # of any installed package; see the module
            report[title] = {"failed": sentence_of(error)}
            problems.append(f"{title} could not be examined: {sentence_of(error)}")
    return report, problems


def versions(problems: list[str]) -> Section:
    """Python, platform, and the packages that dvo needs.

    Args:
        problems: packages that are missing or cannot be imported are added.
    """
    from dvo import __version__

    found = {
        "dvo": f"{__version__} in {_short(Path(__file__).resolve().parents[1])}",
        "python": f"{platform.python_version()} ({_short(sys.executable)})",
        "platform": platform.platform(),
    }
    for name, module in REQUIRED:
        try:
            loaded = import_module(module)
        except Exception as error:  # a missing library of the system, for instance
            found[name] = f"cannot be imported: {sentence_of(error)}"
            problems.append(f"{name} cannot be imported ({sentence_of(error)}). {_AGAIN} {name}")
        else:
            found[name] = version_of(name) or str(getattr(loaded, "__version__", "unknown"))
    opencv = [name for name in ("opencv-python", "opencv-contrib-python") if version_of(name)]
    if opencv and version_of("opencv-python-headless"):
        problems.append(
            f"{opencv[0]} and opencv-python-headless overwrite each other's files. Uninstall both, then: "
            "pip install opencv-python-headless"
        )
    return found


def devices(problems: list[str]) -> Section:
    """Devices of torch, whether float64 works on them, and the one that ``--device auto`` takes.

    Args:
        problems: devices that do not work are added.
    """
    import torch

    from dvo.commands.console import device_of

    found = {"cpu": f"{processor_name()}; {arithmetic_state('cpu', problems)}"}
    accelerator = getattr(torch, "accelerator", None)  # torch 2.6 and newer
    if accelerator is not None and accelerator.is_available():
        kind = accelerator.current_accelerator().type
        backend = torch.get_device_module(kind)
        for number in range(accelerator.device_count()):
            name = f"{kind}:{number}"
            model = backend.get_device_name(number) if hasattr(backend, "get_device_name") else "accelerator"
            found[name] = f"{model}; {arithmetic_state(name, problems)}"
    else:
        found["accelerator"] = "none"
    found["auto"] = str(device_of("auto"))
    return found


def threads(problems: list[str]) -> Section:
    """Number of threads as an odometry gets it, how they wait, and who chose that.

    Args:
        problems: several threads that spin are added.
    """
    import cv2

    from dvo.core.threads import settle_threads

    now = settle_threads()
    if now.count > 1 and now.waits_by == "OpenMP":
        problems.append("threads spin, which is slow beside other programs. Set OMP_WAIT_POLICY=PASSIVE")
    return {
        "torch": f"{now.count}, chosen by {now.chosen_by}",
        "waiting": f"{now.wait_policy}, chosen by {now.waits_by}",
        "opencv": str(cv2.getNumThreads()),
        "cores": f"{now.cores} available of {os.cpu_count()}",
    }


def codecs(problems: list[str]) -> Section:
    """Backends of OpenCV that read videos; formats that are written and read back as a test.

    Args:
        problems: formats that cannot be read are added.
    """
    import cv2

    registry = cv2.videoio_registry
    backends = [registry.getBackendName(code) for code in registry.getStreamBackends() if registry.hasBackend(code)]
    found = {"backends": ", ".join(backends) or "none"}
    if "FFMPEG" in backends:
        lines = map(str.split, cv2.getBuildInformation().splitlines())
        library = next((line[2].strip("()") for line in lines if line[:2] == ["avcodec:", "YES"] and line[2:]), "")
        found["FFmpeg in OpenCV"] = f"libavcodec {library}".strip()
    else:
        found["FFmpeg in OpenCV"] = _MISSING
        problems.append(f"OpenCV has no FFmpeg, so most videos cannot be read. {_AGAIN} opencv-python-headless")
    found["ffmpeg program"] = shutil.which("ffmpeg") or f"{_MISSING} (only needed to convert videos by hand)"
    for name, code, suffix in _VIDEOS:
        found[name] = video_state(code, suffix)
    images = [suffix for suffix in _IMAGES if image_works(suffix)]
    found["images"] = " ".join(images) or "none"
    if broken := [suffix for suffix in (".png", ".jpg") if suffix not in images]:
        problems.append(f"OpenCV cannot read {' and '.join(broken)}. {_AGAIN} opencv-python-headless")
    return found


def weights(problems: list[str]) -> Section:
    """Weights of the package: whether they load, and their checksum.

    Args:
        problems: files that do not load, or differ from the installed ones, are added.
    """
    from dvo.models.weights import FOLDER, load_weights

    found = {}
    for path in sorted(FOLDER.glob("*.safetensors")):
        content = path.read_bytes()
        state = checksum_state(path, content)
        if state == "differs":
            problems.append(f"weights {path.name} differ from those that were installed. Install dvo again")
        try:
            parameters = sum(parameter.numel() for parameter in load_weights(str(path)).model.parameters())
            loads = f"loads, {parameters:,} parameters"
        except Exception as error:  # of another package's network too
            loads = f"does not load: {sentence_of(error)}"
            problems.append(f"weights {path.name} do not load ({sentence_of(error)}). Install dvo again")
        found[path.stem] = f"{loads}; sha256 {hashlib.sha256(content).hexdigest()[:16]} ({state})"
    if not found:
        problems.append(f"no weights in {_short(FOLDER)}. Install dvo again")
    return found


def folders(problems: list[str]) -> Section:
    """Folders of recordings, of cached renderings and of results.

    Args:
        problems: folders that are set but missing, or cannot be written, are added.
    """
    from dvo.data.files.root import VARIABLE, data_root

    data = data_root(required=False)
    given = VARIABLE in os.environ
    if given and not data.is_dir():
        problems.append(f"{VARIABLE} names {_short(data)}, which is no folder. Set it to that of the recordings")
    cache = Path(os.environ.get("DVO_CACHE") or Path.home() / ".cache" / "dvo")
    nearest = next(folder for folder in (cache, *cache.absolute().parents) if folder.exists())
    writable = nearest.is_dir() and os.access(nearest, os.W_OK)
    if not writable:
        problems.append(f"the cache {_short(cache)} cannot be written. Set DVO_CACHE to another folder")
    here = Path.cwd()
    return {
        f"data (${VARIABLE})": f"{_short(data)}: {_entries(data)}{'' if given else ' (default, variable not set)'}",
        "cache ($DVO_CACHE)": f"{_short(cache)}: {_entries(cache)}, {'writable' if writable else 'not writable'}",
        "results (runs/)": f"{_short(here)}: {'writable' if os.access(here, os.W_OK) else 'not writable, use --out'}",
    }


def optional_packages(problems: list[str]) -> Section:
    """Packages that only some commands need: version, or how to install them.

    Args:
        problems: unchanged; none of them has to be there.
    """
    found = {}
    for name, module, use, install in OPTIONAL:
        state = f"{_MISSING}, {install or 'pip install ' + name}"
        if find_spec(module) is not None:
            state = version_of(name) or "installed"
        found[name] = f"{use}: {state}"
    return found


def registered(problems: list[str]) -> Section:
    """Parts that other packages bring through entry points.

    Args:
        problems: unchanged.
    """
    entries = {group: sorted(entry.name for entry in importlib.metadata.entry_points(group=group)) for group in GROUPS}
    return {group: ", ".join(names) for group, names in entries.items() if names} or {"none": ""}


def _entries(folder: Path) -> str:
    if not folder.is_dir():
        return "not there"
    count = sum(1 for _ in folder.iterdir())
    return f"{count} {'entry' if count == 1 else 'entries'}"


def _short(path: Path | str) -> str:
    """Path with ``~`` for the home folder, as reports are made public."""
    path = Path(path)
    return str(Path("~") / path.relative_to(Path.home())) if path.is_relative_to(Path.home()) else str(path)
