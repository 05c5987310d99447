"""``dvo synth preview | export``: contact sheets of scenes and meshes, and sequences written to disk."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.progress import Progress

from dvo.commands.console import device_of, say, warn
from dvo.commands.places import check_outputs
from dvo.core.errors import DvoError
from dvo.core.text import print_line
from dvo.data.files.output import check_place, replaced, spelled_in_text
from dvo.data.inertial import NOISE_PRESETS
from dvo.synth import FAMILIES, MeshScene, load_mesh
from dvo.synth.export import export_sequence, mesh_sequence
from dvo.synth.preview import contact_sheet, family_sheet, sequence_rows
from dvo.synth.sequence import SyntheticSequence, make_sequence
from dvo.synth.specs import CameraSpec, MotionSpec, SceneSpec, SequenceFormat, SequenceSpec

MOST_PIXELS = 2**25  # of a column of a contact sheet


def preview(arguments: argparse.Namespace) -> int:
    """Write a contact sheet of a family, of a mesh, of training clips or of all families.

    Args:
        arguments: of the command line.

    Returns:
        Exit code.

    Raises:
        DvoError: a file that cannot be written, an unknown family or mesh, options that do not combine.
    """
    out = Path(arguments.out)
    if not out.parent.is_dir() or out.suffix.lower() not in (".png", ".jpg"):
        raise DvoError("cannot be written", file=out, field="--out", remedy="name a .png in a folder that exists")
    check_outputs({"--out": out}, {"SOURCE": arguments.source}, arguments.textures)
    check_place(out, "--out")
    width, height = arguments.size
    most = arguments.rows or len(list(FAMILIES))
    if most * width * height > MOST_PIXELS:
        message = f"too large: {most} rows of {width}x{height} pixels"
        raise DvoError(message, field="--size, --rows", remedy="give a smaller size or fewer rows")
    if arguments.source == "clips":  # what training sees
        sheet = contact_sheet(
            arguments.seed, arguments.rows or 8, height=height, width=width, clips_per_scene=1,
            textures=arguments.textures,
        )  # fmt: skip
    elif arguments.source is None or arguments.source in FAMILIES:
        names = list(FAMILIES) if arguments.source is None else [arguments.source] * (arguments.rows or 4)
        seeds = [arguments.seed + (i if arguments.source else 0) for i in range(len(names))]
        sheet = family_sheet(names, seeds, height, width, textures=arguments.textures)
    else:
        if arguments.textures is not None:
            raise DvoError("a mesh brings its own textures", field="--textures", remedy="leave it out")
        rows = arguments.rows or 3
        mesh, form = _mesh(arguments, arguments.source), SequenceFormat(60, height, width, fps=10)
        for file in mesh.files:
            check_outputs({"--out": out}, {"SOURCE": file})
        sequences = [mesh_sequence(mesh, arguments.seed + i, form) for i in range(rows)]
        sheet = np.concatenate([sequence_rows(sequence) for sequence in sequences])
    with replaced(out) as part, spelled_in_text(part) as name:
        if not cv2.imwrite(name, sheet[..., ::-1]):
            raise DvoError("cannot be written", file=out, field="--out", remedy="name a file elsewhere")
    say(f"{out}: frames, depth (near is red), flow (hue is direction), path from above")
    return 0


def export(arguments: argparse.Namespace) -> int:
    """Write a sequence in the layout of TUM RGB-D, TartanAir or EuRoC.

    Args:
        arguments: of the command line.

    Returns:
        Exit code.

    Raises:
        DvoError: a folder that cannot be written, an unknown family or mesh, options that do not combine.
    """
    width, height = arguments.size
    device = device_of(arguments.device)
    form = SequenceFormat(arguments.frames, height, width, arguments.fps)
    motion = MotionSpec(arguments.path)
    sequence: SyntheticSequence
    if arguments.mesh is not None:
        options = {"--textures": arguments.textures, "--sensor": arguments.sensor, "--lens": arguments.lens}
        for option, given in options.items():
            if given not in (None, False, "none"):
                raise DvoError("does not go with --mesh", field=option, remedy="leave it out")
        sequence = mesh_sequence(
            _mesh(arguments, arguments.mesh), arguments.seed, form, motion, name=Path(arguments.mesh).stem,
            device=device,
        )  # fmt: skip
    else:
        spec = SequenceSpec(
            form, SceneSpec(arguments.family, textures=arguments.textures), motion,
            CameraSpec(sensor=arguments.sensor, lens=arguments.lens),
        )  # fmt: skip
        sequence = make_sequence(arguments.seed, spec, device=device)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("rendering", total=arguments.frames)
        notes = export_sequence(
            sequence,
            arguments.out,
            arguments.layout,
            on_frame=lambda done: progress.update(task, completed=done),
            noise=NOISE_PRESETS.get(arguments.imu_noise),
        )
    for note in notes:
        warn(note, "note")
    say(f"{arguments.out}: {arguments.frames} frames of {sequence.name}, {width}x{height}, {arguments.layout} layout")
    say(f"track it: dvo run {arguments.out}")
    return 0


def _mesh(arguments: argparse.Namespace, path: str) -> MeshScene:
    if Path(path).suffix == "" and not Path(path).exists():
        known = ", ".join(FAMILIES)
        raise DvoError(f"neither a mesh file nor a family: {path}", field="SOURCE", remedy=f"families: {known}")
    scene = load_mesh(path, up=arguments.up, view=arguments.view, light=not arguments.unlit, seed=arguments.seed)
    where = "within" if scene.space.inside else "around"
    print_line(f"{path}: {len(scene):,} triangles; the camera moves {where} it", error=True)
    for warning in scene.warnings:
        warn(warning)
    return scene
