"""Kernels of the tracker, which a thread loads from the disk while the first frames are read.

Numba takes a second to load them, once in a process. The thread begins when a tracker is built, so that no frame waits
for them, nor a program that builds one and does other things. It compiles nothing: a kernel that is not on the disk is
left to its first call, or to :mod:`dvo.core.ahead`.
"""

from __future__ import annotations

import contextlib
import os
import threading
from functools import cache
from importlib import import_module

KERNELS = {
    "dvo.geometry.projection_kernels:project_patches": (
        "f4[:,:,::1], f4[:,:,:,::1], f4[:,:,::1], i8[::1], i8[::1], i8[::1], f8, f8, f4[:,:,:,::1], "
        "f4[:,:,::1], b1[:,:,::1]"
    ),
    "dvo.nets.patch.selection_kernels:structure_scores": "u1[:,:,:], i8[:,::1], i8, i8, f4[::1]",
    "dvo.nets.patch.encoder_kernels:normalise": "f4[:,:,::1], f8, b1, f4[:,:,::1]",
    "dvo.nets.correlation.edge_correlation_kernels:correlate": (
        "f4[:,:,:,::1], f4[:,:,::1], f4[:,:,::1], i8[::1], i8[::1], i8, f4[:,:,:,::1]"
    ),
    "dvo.nets.update.update_kernels:normalise": "f4[:,::1], f4[::1], f4[::1], f8, b1",
    "dvo.nets.update.update_kernels:join": "f4[:,::1], f4[:,::1], f4[:,::1], f4[::1], f4[::1], f8, f4[:,::1]",
    "dvo.nets.update.update_kernels:neighbours": "f4[:,::1], f4[:,::1], i8[::1], b1[::1], f4[:,::1]",
    "dvo.nets.update.update_kernels:add": "f4[:,::1], f4[:,::1]",
    "dvo.nets.update.update_kernels:pool": "f4[:,::1], f4[:,::1], i8[:,::1], b1[:,::1], f4[:,::1]",
    "dvo.nets.update.update_kernels:spread": "f4[:,::1], f4[:,::1], i8[::1]",
    "dvo.nets.update.update_kernels:gate": "f4[:,::1], f4[:,::1], f4[:,::1], f4[::1], f4[::1], f8",
    "dvo.nets.alignment.alignment_kernels:align": (
        "f4[:,:,::1], i8[::1], i8[::1], f4[:,::1], f4[:,::1], f4[:,:,::1], i8, i8, f8, f8, f4[:,::1], f4[:,::1]"
    ),
    "dvo.nets.alignment.alignment_kernels:warps_of": "f4[:,:,:,::1], f4[:,:,::1], f8, f8, f4[:,:,::1]",
    "dvo.nets.alignment.alignment_kernels:accepted": (
        "f4[:,::1], f4[::1], f4[::1], f4[:,::1], i8, i8, i8, f8, f8, f8, b1[::1]"
    ),
    "dvo.nets.alignment.alignment_kernels:texture": "f4[:,:,::1], i8[::1], f4[:,::1], i8, f4[::1]",
    "dvo.ba.layer.edgewise_kernels:frame_pairs": "i8[::1], i8[::1], i8[::1], i8, i8",
    "dvo.ba.layer.edgewise_kernels:take_steps": (
        "f4[:,:,::1], f4[:,::1], f4[:,:,::1], f4[:,:,::1], f4[:,:,::1], f4[:,:,::1], i8[::1], i8[::1], "
        "i8[::1], i8[::1], i8[:,::1], i8[::1], i8, b1, UniTuple(f8, 7), i8, f8, f8, f8, f8, f8, i8"
    ),
    "dvo.ba.layer.edgewise_kernels:robust_cost": (
        "f8[:,::1], f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], i8[::1], i8[::1], i8[::1], i8[::1], "
        "i8[:,::1], UniTuple(f8, 7), i8, b1[::1]"
    ),
    "dvo.odometry.window.window_kernels:support": (
        "i8, b1, i8[::1], i8[::1], i8, f4[:,::1], f4[:,:,:,::1], f4[:,::1], f4[:,::1], f4[:,::1], f8, f8, f8"
    ),
    "dvo.odometry.window.window_kernels:solve_pose_kernel": (
        "f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1], i8, f8, f8"
    ),
    "dvo.ba.layer.edgewise_kernels:add_reprojection": (
        "f8[:,::1], f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], i8[::1], i8[::1], i8[::1], i8[::1], "
        "i8[:,::1], i8[::1], b1, UniTuple(f8, 7), i8, f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8[::1]"
    ),
    "dvo.ba.layer.edgewise_kernels:solve_reduced": (
        "f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8[::1], f8, f8, f8[::1], f8[::1], f8[::1]"
    ),
    "dvo.ba.layer.edgewise_kernels:move_poses": "f8[:,::1], i8[::1], f8[::1]",
    "dvo.ba.sparse.schur_kernels:observations": "i8[::1], i8[::1], i8, i8",
    "dvo.ba.sparse.schur_kernels:find": "i8[::1], i8[::1], i8[::1], i8[::1], i8",
    "dvo.ba.sparse.edge_kernels:cost": (
        "f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], i8[::1], i8[::1], "
        "i8[::1], i8[::1], b1[:,::1], i8[::1], i8, f8, f8"
    ),
    "dvo.ba.sparse.edge_kernels:accumulate": (
        "f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], i8[::1], i8[::1], "
        "i8[::1], i8[::1], b1[:,::1], i8[::1], i8, f8, f8, i8[::1], i8[::1], i8[::1], i8[::1], i8[::1], "
        "f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1]"
    ),
    "dvo.ba.sparse.schur_kernels:to_poses": "f8[:,::1], i8[::1], i8[::1], i8, f8[::1], f8[:,::1]",
    "dvo.ba.sparse.schur_kernels:coupled": "i8[::1], i8[::1], i8, i8, i8[::1]",
    "dvo.ba.sparse.schur_kernels:reduce": (
        "f8[:,::1], i8[::1], i8[::1], f8[::1], i8, i8[::1], i8[::1], i8[::1], i8[::1], f8[:,:,::1]"
    ),
    "dvo.ba.sparse.column_kernels:eliminate": "i8, i8[::1], i8[::1], i8",
    "dvo.ba.sparse.column_kernels:places": "i8[::1], i8[::1], i8[::1], i8[::1], i8[::1]",
    "dvo.ba.sparse.column_kernels:solve": (
        "i8[::1], i8[::1], i8[::1], i8[::1], i8[::1], i8[::1], f8[:,:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[::1]"
    ),
    "dvo.ba.sparse.schur_kernels:to_depths": "f8[:,::1], i8[::1], i8[::1], i8, f8[:,::1], f8[::1]",
    "dvo.ba.sparse.edge_kernels:inliers": (
        "f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], i8[::1], i8[::1], "
        "i8[::1], i8[::1], b1[:,::1], i8[::1], f8"
    ),
    "dvo.odometry.window.window_kernels:mean_flow": "f4[::1], f4[::1], f4[::1], f4[::1], f4[:,:,:,::1], f8, f8",
    "dvo.odometry.global_ba.shutter_kernels:global_shutter": (
        "f8[:,:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], i8[::1], i8[::1], i8[::1], "
        "i8[::1], f8[:,::1], f8[:,:,::1], f8, f8, f8"
    ),
    "dvo.odometry.checks.fit_kernels:fit": (
        "f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], i8, f8, f8, i8, f8, f8, f8"
    ),
}
"""Kernels in the order in which a run needs them, each with the types of its arguments."""
BFLOAT16_KERNELS = {
    "dvo.nets.patch.encoder_kernels:normalise_bfloat16": "u2[:,:,::1], f8, b1, u2[:,:,::1]",
    "dvo.nets.correlation.edge_correlation_kernels:correlate_bfloat16": (
        "u2[:,:,:,::1], u2[:,:,::1], f4[:,:,::1], i8[::1], i8[::1], i8, u2[:,:,:,::1]"
    ),
    "dvo.nets.update.update_kernels:normalise": "u2[:,::1], u2[::1], u2[::1], f8, b1",
    "dvo.nets.update.update_kernels:join": "f4[:,::1], f4[:,::1], u2[:,::1], u2[::1], u2[::1], f8, u2[:,::1]",
    "dvo.nets.update.update_kernels:neighbours": "u2[:,::1], u2[:,::1], i8[::1], b1[::1], u2[:,::1]",
    "dvo.nets.update.update_kernels:add": "u2[:,::1], u2[:,::1]",
    "dvo.nets.update.update_kernels:pool": "u2[:,::1], u2[:,::1], i8[:,::1], b1[:,::1], u2[:,::1]",
    "dvo.nets.update.update_kernels:spread": "u2[:,::1], u2[:,::1], i8[::1]",
    "dvo.nets.update.update_kernels:gate": "u2[:,::1], u2[:,::1], u2[:,::1], u2[::1], u2[::1], f8",
}
"""Those of a CPU that multiplies bfloat16, which come first there, and in place of those of the same name."""


INT8_KERNELS = {
    "dvo.nets.correlation.edge_correlation_kernels:round_pixels": (
        "f4[:,:,::1], i8, u1[:,:,:,::1], f4[:,::1], f4[:,::1]"
    ),
    "dvo.nets.correlation.edge_correlation_kernels:correlate_bytes": (
        "u1[:,:,:,:,::1], f4[:,:,::1], i1[:,:,::1], f4[:,:,::1], f4[:,:,::1], i8[::1], i8[::1], i8, f4[:,:,:,::1]"
    ),
    "dvo.nets.update.int8_kernels:quantise": "f4[:,::1], f4[:,::1], b1, u4[:,:,::1], f4[::1], f4[::1]",
    "dvo.nets.update.int8_kernels:multiply": ("u4[:,:,::1], f4[::1], f4[::1], i1[:,:,:,::1], f4[:,:,::1], f4[:,::1]"),
}
"""Those of a CPU that tracks in 8 bits, and of float32 in what is not."""
INT8_BFLOAT16_KERNELS = {
    "dvo.nets.correlation.edge_correlation_kernels:round_pixels": (
        "f4[:,:,::1], i8, u1[:,:,:,::1], f4[:,::1], f4[:,::1]"
    ),
    "dvo.nets.correlation.edge_correlation_kernels:correlate_bytes": (
        "u1[:,:,:,:,::1], f4[:,:,::1], i1[:,:,::1], f4[:,:,::1], f4[:,:,::1], i8[::1], i8[::1], i8, u2[:,:,:,::1]"
    ),
    "dvo.nets.update.int8_kernels:quantise": "u2[:,::1], u2[:,::1], b1, u4[:,:,::1], f4[::1], f4[::1]",
    "dvo.nets.update.int8_kernels:multiply": ("u4[:,:,::1], f4[::1], f4[::1], i1[:,:,:,::1], f4[:,:,::1], u2[:,::1]"),
}
"""Those of one that multiplies bfloat16 too."""


_INSTEAD = {
    "dvo.nets.patch.encoder_kernels:normalise": {"dvo.nets.patch.encoder_kernels:normalise_bfloat16"},
    "dvo.nets.correlation.edge_correlation_kernels:correlate": {
        "dvo.nets.correlation.edge_correlation_kernels:correlate_bfloat16",
        "dvo.nets.correlation.edge_correlation_kernels:correlate_bytes",
    },
    "dvo.nets.correlation.edge_correlation_kernels:correlate_bfloat16": {
        "dvo.nets.correlation.edge_correlation_kernels:correlate_bytes"
    },
}  # kernels that are not needed where one of some others is


_LONGEST = "dvo.ba.layer.edgewise_kernels:take_steps"


def needed() -> dict[str, str]:
    """Kernels of this machine, see :data:`KERNELS`; the one that takes longest to compile is the first."""
    from dvo.core.compiled import compiles_bfloat16, prefers_int8

    half, found = compiles_bfloat16(), KERNELS
    if half:
        found = BFLOAT16_KERNELS | {name: types for name, types in found.items() if name not in BFLOAT16_KERNELS}
    if prefers_int8():
        found = (INT8_BFLOAT16_KERNELS if half else INT8_KERNELS) | found
    # Another process compiles the longest one while this one compiles what comes before it.
    found = dict(sorted(found.items(), key=lambda kernel: kernel[0] != _LONGEST))
    return {name: types for name, types in found.items() if not _INSTEAD.get(name, set()) & found.keys()}


@cache
def load_in_background() -> None:
    """Begin to load the kernels that are on the disk, once in a process."""
    thread = threading.Thread(target=_load, name="dvo-kernels")
    with contextlib.suppress(RuntimeError):  # a limit of threads: each is loaded when it is first called
        thread.start()
        if hasattr(os, "register_at_fork"):  # a forked process would have the locks of the thread, and not the thread
            os.register_at_fork(before=thread.join)


def _load() -> None:
    from dvo.core.kernels import available

    if not available():
        return
    from dvo.core.compiled import load_kept

    for name, types in needed().items():
        if not threading.main_thread().is_alive():  # the interpreter waits for this thread before it ends
            return
        module, function = name.split(":")
        load_kept(getattr(import_module(module), function), types)
