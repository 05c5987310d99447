"""Settings of the tracker."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from dvo.ba.kernels import Kernel
from dvo.core.errors import DvoError
from dvo.core.settings import check_names, check_settings, settings_of, shown
from dvo.core.text import choice
from dvo.map.measurements import SIGMA
from dvo.nets.alignment.alignment import AlignmentOptions
from dvo.odometry.depth.scale_options import ScaleOptions
from dvo.odometry.global_ba.final_adjustment import AdjustmentOptions
from dvo.odometry.inertial.options import InertialOptions
from dvo.odometry.loops.options import LoopOptions
from dvo.odometry.window.patch_window import InsertPolicy, Round, StepSettings
from dvo.odometry.window.sensors import WINDOW_SENSORS

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

C = TypeVar("C", bound="DataclassInstance")

Policy = Literal["continuous", "retry", "late", "located"]
"""What a frame follows that is tried in the window."""
Precision = Literal["auto", "float32", "bfloat16", "int8"]
"""Type of the numbers that the network multiplies. ``int8``: the update operator in 8 bits, and the encoder in bfloat16
on a CPU with instructions for it. ``auto``: int8 or bfloat16 on a CPU with instructions for it, the faster one."""
InitialPose = Literal["motion", "nearest"]
"""First pose of a new frame: of the motion model, or from matches with the newest keyframe."""

_RANGES = {
    "pixels": (0, 2**28),
    "patches": (1, 2**14),
    "align_gain": (0, 1e4),
    "align_reach": (0, 100),
    "align_slope": (0, 1),
    "lifetime": (1, 1000),
    "removal": (1, 1000),
    "robust": (0, 1e4),
    "sigma": (1e-6, 1e3),
    "covariance_scale": (1e-6, 1e6),
    "optimisation": (1, 1000),
    "initial_frames": (2, 1000),
    "initial_updates": (1, 1000),
    "final_updates": (0, 1000),
    "updates": (1, 1000),
    "initial_motion": (0, math.inf),
    "initial_parallax": (0, math.inf),
    "initial_inliers": (0, 1),
    "keyframe_motion": (0, math.inf),
    "network_motion": (0, math.inf),
    "keyframe_index": (2, 1000),
    "motion_damping": (0, 1),
    "lost_confidence": (0, 1),
    "patience": (1, 10**9),
    "search_updates": (1, 1000),
    "min_inliers": (0, 1),
    "search_inliers": (0, 1),
    "join_inliers": (0, 1),
    "max_gap": (1, math.inf),
}


@dataclass(frozen=True)
class TrackerConfig:
    """Settings of :class:`dvo.odometry.patch.tracker.PatchOdometry`.

    Attributes:
        pixels: largest number of pixels of the working image; the aspect is kept (0: full resolution).
        patches: number of patches in each frame.
        selection: of the patches, a name in :data:`dvo.nets.patch.selection.SELECTIONS`; empty for the one that the
            network was trained with.
        align: sub-pixel alignment of the measurements (:mod:`dvo.nets.alignment.alignment`), with the three settings
            below: ``final`` for those that leave the window, which serves the final adjustment, and of frames that
            have moved little (``network_motion``); ``none``.
        align_gain: factor of the weight of aligned measurements in bundle adjustment.
        align_reach: largest distance of an alignment from the measurement of the network, feature pixels.
        align_slope: standard deviation, 1 / feature pixel, of the slopes of surfaces that an alignment of measurements
            that leave the window finds too (:mod:`dvo.nets.patch.slopes`); 0: surfaces of constant depth.
        lifetime: largest distance, in frames, of the edges of a patch from its own frame.
        edges: frames up to this distance that a patch has edges into: ``all``, or ``spread``, the next four and every
            second one of the others, so that as many edges see a point from places farther apart (docs/precision.md).
        removal: age, in frames, above which the edges of a frame's patches are archived.
        optimisation: number of newest frames whose poses are optimised.
        final_adjustment: solve for all frames of a segment at once in ``finish``
            (:mod:`dvo.odometry.global_ba.final_adjustment`).
        estimate_readout: look for a rolling shutter in the final adjustment if the camera states no readout time
            (:mod:`dvo.odometry.global_ba.self_calibration`).
        loops: close loops, and join segments that show the same place (:mod:`dvo.odometry.loops.closure`).
        loop: how loops are searched for, a
            :class:`dvo.odometry.loops.options.LoopOptions`; a table of its values will do.
        real_time: never wait in ``track`` for a search for loops or a correction by one. Results are then taken when
            they are there, which depends on the load of the machine: the same frames need not give the same bytes.
            ``save`` and ``finish`` wait.
        adjust_after_loop: bundle adjustment of all archived keyframes after each correction by a loop, beside tracking
            (:mod:`dvo.odometry.global_ba.graph_adjustment`).
        robust: width of the Cauchy kernel of bundle adjustment in ``track``, feature pixels; 0 for no kernel.
        sigma: standard deviation of a measurement of confidence 1, feature pixels, with the shipped weights; variances
            are ``sigma^2`` over the confidence (docs/precision.md, "Weights in pixels"). It scales covariances
            (:attr:`dvo.odometry.protocol.Estimate.covariance`; :attr:`dvo.ba.options.BAOptions.sigma`); of what poses
            depend on, it decides only how often a second solution is looked for.
        covariance_scale: factor of the covariances beyond ``sigma^2``, as errors of measurements are not independent,
            with the shipped weights: fitted by ``python -m eval.benchmarks.covariance`` (docs/uncertainty.md).
        restart: start the window anew, some frames after the initialisation, and the final adjustment, if that leads to
            a better solution (:mod:`dvo.ba.multistart`).
        initial_frames: keyframes before the first joint optimisation.
        initial_updates, final_updates: updates at initialisation, at most, and in ``finish``.
        updates: updates of each frame.
        initial_motion: median revision of the flow, in feature pixels, above which a frame becomes a keyframe before
            initialisation.
        initial_parallax: median parallax without rotation, in feature pixels, above which the status is ``tracking``.
        initial_inliers: share of the patches of two consecutive keyframes found in each other, at initialisation, below
            which they do not show the same scene.
        keyframe_motion: a keyframe is dropped again if the mean flow between its neighbours, in feature pixels, is
            below this.
        network_motion: mean flow since the last frame that the network has measured, in feature pixels, up to which a
            frame is aligned with the keyframes instead (:mod:`dvo.odometry.window.frame_alignment`), but not above half
            of ``keyframe_motion``; 0: the network measures every frame. Without an alignment (``align``) it does too.
        keyframe_index: position of the keyframe that this test is applied to, counted from the newest.
        motion_damping: factor of the last motion in the prediction of the next pose, in [0, 1].
        initial_pose: see :data:`InitialPose` (:mod:`dvo.odometry.patch.initial_pose`).
        patience: number of frames with content that are tried after a loss before a new segment begins with them.
        search_updates: recurrent updates of a frame after a lost one or a gap in time, to join it with the window, and
            further ones of a frame that would be lost otherwise.
        lost_confidence: mean confidence of the newest frame's edges below which the status is ``lost``.
        min_inliers: share of the window's patches found in the newest frame below which further updates are made.
        search_inliers: the same share below which the status is ``lost``, for a frame after further updates.
        join_inliers: the same for a frame after a lost one, or after a gap in time. Between poses that are far apart,
            bundle adjustment fits a wrong pose to some matches at no cost; where a tenth to a fifth of the patches is
            found, it usually has. Right poses had more than 0.3.
        max_gap: time between frames above which they are separated by a gap, in medians of the recent intervals.
        scale: observation that metres come from, none for a trajectory up to scale; a table of its values will do.
        inertial: use of inertial samples that frames bring, a :class:`dvo.odometry.inertial.options.InertialOptions`; a
            table of its values will do.
        precision: see :data:`Precision` (``PatchVO.in_bfloat16``, ``PatchVO.in_int8``). All else is computed in
            float32 and float64. ``run.json`` says which one it was.
        sensors: names of others whose measurements take part in every step of an initialised window
            (:data:`dvo.odometry.window.sensors.WINDOW_SENSORS`), with commas between or as a list.

    Raises:
        DvoError: a value of the wrong type or out of range, with the name of the setting.

    Example:
        >>> config = dvo.TrackerConfig(patches=48, optimisation=10)
        >>> odometry = dvo.load("small", config=config)
    """

    pixels: int = 320 * 240
    patches: int = 24
    selection: str = ""
    align: Literal["none", "final"] = "final"
    align_gain: float = 10.0
    align_reach: float = 0.3
    align_slope: float = 0.0
    lifetime: int = 7
    edges: Literal["all", "spread"] = "all"
    removal: int = 9
    optimisation: int = 8
    initial_frames: int = 5
    initial_updates: int = 16
    final_updates: int = 2
    final_adjustment: bool = True
    estimate_readout: bool = True
    loops: bool = True
    loop: LoopOptions = LoopOptions()  # noqa: RUF009 (frozen)
    real_time: bool = False
    adjust_after_loop: bool = False
    robust: float = 0.3
    sigma: float = SIGMA
    covariance_scale: float = 2.0
    restart: bool = True
    updates: int = 1
    initial_motion: float = 0.5
    initial_parallax: float = 1.0
    initial_inliers: float = 0.1
    keyframe_motion: float = 5.0
    network_motion: float = 0.8
    keyframe_index: int = 4
    motion_damping: float = 0.5
    initial_pose: InitialPose = "motion"
    lost_confidence: float = 0.01
    patience: int = 8
    search_updates: int = 8
    min_inliers: float = 0.04
    search_inliers: float = 0.1
    join_inliers: float = 0.25
    max_gap: float = 4.5
    scale: ScaleOptions = ScaleOptions()  # noqa: RUF009 (frozen)
    inertial: InertialOptions = InertialOptions()  # noqa: RUF009 (frozen)
    precision: Precision = "auto"
    sensors: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        names = self.sensors.split(",") if isinstance(self.sensors, str) else self.sensors
        if not isinstance(names, (tuple, list)) or not all(isinstance(name, str) for name in names):
            raise DvoError(f"not a list of names: {shown(names)}", field="sensors", remedy="give NAME,NAME")
        object.__setattr__(self, "sensors", tuple(name for name in names if name and WINDOW_SENSORS.target(name)))
        object.__setattr__(self, "scale", settings_of(ScaleOptions, self.scale, "scale"))
        object.__setattr__(self, "inertial", settings_of(InertialOptions, self.inertial, "inertial"))
        object.__setattr__(self, "loop", settings_of(LoopOptions, self.loop, "loop"))
        check_settings(self, _RANGES)

    @property
    def kernel(self) -> Kernel:
        """Robust kernel of bundle adjustment in ``track``."""
        return Kernel("cauchy", self.robust) if self.robust > 0 else Kernel()

    @property
    def measuring(self) -> StepSettings:
        """How edges are measured, those of the window and between images that are not in it."""
        return StepSettings(self.kernel, self.alignment, self.align)

    @cached_property
    def policies(self) -> dict[Policy, InsertPolicy]:
        """How frames are tried in the window, by what they follow.

        - ``continuous``: the frame before it. A fast motion may need more updates, but then has to be found for sure.
        - ``retry``: frames without a pose, or a gap in time. Its pose relative to the window cannot be checked by
          continuity, so that more agreement is required.
        - ``late``: the same, once a frame after it is part of the window, which has to be supported again.
        - ``located``: a place of the map that it was found at; its pose was checked there.
        """
        few, many = self.updates, self.search_updates
        joined = (Round(many, self.join_inliers),)
        searched = (Round(few, self.min_inliers), Round(many, self.search_inliers))
        common = InsertPolicy(self.distances, self.optimisation, searched, self.lost_confidence)
        return {
            "continuous": common,
            "retry": replace(common, rounds=joined),
            "late": replace(common, rounds=joined, later=1),
            "located": replace(common, rounds=(Round(many, 1.0),), checked=False),
        }

    @cached_property
    def distances(self) -> tuple[int, ...]:
        """Distances of the edges of a patch from its own frame, in frames."""
        every = range(1, self.lifetime + 1)
        return tuple(d for d in every if self.edges == "all" or d <= 4 or d % 2 == 0 or d == self.lifetime)

    @property
    def aligned_motion(self) -> float:
        """Mean flow since the last frame of the network up to which frames are aligned, feature pixels."""
        return 0.0 if self.align == "none" else min(self.network_motion, self.keyframe_motion / 2)

    @cached_property
    def variance(self) -> float:
        """Variance that covariances are scaled by, feature pixels squared."""
        return self.sigma**2 * self.covariance_scale

    @property
    def alignment(self) -> AlignmentOptions:
        """Options of the sub-pixel alignment."""
        return AlignmentOptions(gain=self.align_gain, reach=self.align_reach, slope=self.align_slope)

    @property
    def adjustment(self) -> AdjustmentOptions:
        """Options of the final adjustment."""
        return AdjustmentOptions() if self.restart else AdjustmentOptions(restart_frames=0)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> TrackerConfig:
        """Settings from plain values, for instance of a YAML file.

        Args:
            values: attribute name to value; attributes that are missing take their defaults.

        Returns:
            The settings.

        Raises:
            DvoError: an unknown attribute, or a value out of range.
        """
        check_names(cls, values)
        return cls(**values)


TRACKER_PRESETS: dict[str, TrackerConfig] = {
    "small": TrackerConfig(),
    "mamba": TrackerConfig(initial_pose="nearest"),
    "tiny": TrackerConfig(pixels=160 * 120, patches=16),
    # DPVO's "fast" setting.
    "full": TrackerConfig(
        pixels=0,
        patches=48,
        lifetime=11,
        removal=16,
        optimisation=7,
        initial_frames=8,
        initial_updates=12,
        initial_motion=2.0,
        keyframe_motion=15.0,
        network_motion=0.0,
    ),  # fmt: skip
}

PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "fast": {
        "pixels": 256 * 192,
        "patches": 16,
        "lifetime": 5,
        "removal": 7,
        "optimisation": 7,
        "network_motion": 2.5,
    },
    "accurate": {"pixels": 448 * 336, "patches": 48, "updates": 2, "align_slope": 0.03, "network_motion": 0.0},
}
"""Settings that trade accuracy for speed, on top of those of the weights; ``dvo.load("small", preset="fast")``."""


def preset_changes(name: str, presets: Mapping[str, dict[str, Any]] = PRESETS) -> dict[str, Any]:
    """Settings of a preset.

    Args:
        name: of the preset.
        presets: settings of each, those of the tracker unless others are given.

    Returns:
        Setting to value.

    Raises:
        DvoError: no such preset.
    """
    if not isinstance(name, str) or name not in presets:
        raise DvoError(f"unknown preset {shown(name)}", field="preset", remedy=choice(name, presets))
    return presets[name]


def with_changes(config: C, preset: str, presets: Mapping[str, dict[str, Any]], overrides: Mapping[str, Any]) -> C:
    """Settings of an odometry, changed by a preset and by single settings on top of it.

    Args:
        config: settings to begin with, a dataclass.
        preset: name of the preset.
        presets: settings of each.
        overrides: single settings; they win.

    Returns:
        The settings.

    Raises:
        DvoError: no such preset; an unknown or invalid setting.
    """
    check_names(type(config), overrides)
    return replace(config, **{**preset_changes(preset, presets), **overrides})
