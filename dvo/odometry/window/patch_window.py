"""Window of keyframes that a network measures: keyframes, edges, correlation, alignment and the step in one object."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from dvo.ba.kernels import Kernel
from dvo.ba.limits import DEPTH_RANGE, depth_range_of
from dvo.ba.options import BADamping, BAOptions
from dvo.ba.problem import Factor
from dvo.core.context import multiplies_bfloat16
from dvo.map.edges import PatchGraph
from dvo.map.measurements import depth_factors
from dvo.map.window import Keyframe, Window, WindowSnapshot
from dvo.models.patch_vo import PatchVO
from dvo.models.step import Revision, UpdateState, revise, step
from dvo.nets.alignment.alignment import AlignmentOptions
from dvo.nets.correlation.correlation import Correlation
from dvo.nets.correlation.edge_correlation import EdgeCorrelation, fits_bfloat16, fits_bytes, round_channels
from dvo.nets.patch.patchifier import patch_coordinates, pool_levels
from dvo.nets.update.int8 import Int8Linear
from dvo.odometry.frames.front_end import View, keyframe_of
from dvo.odometry.window.alignment import AlignmentSnapshot, WindowAlignment
from dvo.odometry.window.pose_validation import PoseSupport, support_of
from dvo.odometry.window.sensors import WindowSensor


@dataclass(frozen=True)
class StepSettings:
    """How the edges of a window are measured and weighted.

    Attributes:
        kernel: robust kernel of bundle adjustment, which takes the influence from moving bodies and wrong matches.
        alignment: options of the sub-pixel alignment.
        align: which measurements are aligned to a fraction of a pixel: ``final``, those that leave the window, or
            ``none``.
    """

    kernel: Kernel = Kernel()  # noqa: RUF009 (frozen)
    alignment: AlignmentOptions = AlignmentOptions()  # noqa: RUF009 (frozen)
    align: Literal["none", "final"] = "final"


@dataclass(frozen=True)
class Round:
    """Updates of a frame that is tried, after which its pose is supported or not.

    Attributes:
        updates: number of recurrent updates.
        inliers: share of the patches of earlier frames that have to be found in it.
    """

    updates: int
    inliers: float


@dataclass(frozen=True)
class InsertPolicy:
    """How a frame is tried in a window.

    Attributes:
        distances: of the frames on either side of it with which it is connected, in frames.
        optimised: number of newest frames whose poses are solved for.
        rounds: the first that supports the pose ends the try.
        confidence: mean confidence of the edges into it that is needed.
        later: number of frames after it that have to be supported again.
        checked: refuse a frame whose pose is not supported; otherwise it is taken, as its pose was checked before.
    """

    distances: tuple[int, ...]
    optimised: int
    rounds: tuple[Round, ...]
    confidence: float = 0.0
    later: int = 0
    checked: bool = True


@dataclass(frozen=True)
class Attempt:
    """What has become of a frame that was tried.

    Attributes:
        accepted: the window holds it; otherwise the window is as it was before.
        support: of its pose, after the last round.
    """

    accepted: bool
    support: PoseSupport


@dataclass(frozen=True)
class Snapshot:
    """All of a window that a try changes, beside the frames and edges themselves.

    Attributes:
        window: poses, patches and edge states.
        alignment: the image that one more frame replaces; None without an alignment.
    """

    window: WindowSnapshot
    alignment: AlignmentSnapshot | None


class WindowCorrelation:
    """:class:`dvo.nets.correlation.correlation.CorrelationLookup` over a window.

    Args:
        window: provides the edges.
        model: the network, whose precision is that of maps and features where the device multiplies it.
        device: of both.

    Attributes:
        features: ``(N, M, p^2, C)`` matching features of the patches by map slot, as the look-up takes them.
        numbers: ``(N, M, p^2, 2)`` scale and total of features that are whole numbers.
    """

    def __init__(self, window: Window, model: PatchVO, device: torch.device) -> None:
        config = model.config
        self.window, self.pyramid = window, config.pyramid
        dtype = _type_of_maps(model, device)
        self.levels = [EdgeCorrelation(scale, config.radius, device, dtype) for scale in config.pyramid]
        self.features = torch.zeros(0, 0, 0, 0, device=device, dtype=torch.int8 if dtype == torch.uint8 else dtype)
        self.numbers = torch.zeros(0, 0, 0, 2, device=device)

    @property
    def capacity(self) -> int:
        """Number of frames that memory is reserved for."""
        return max(len(level.maps) for level in self.levels)

    def keep(self, keyframe: Keyframe, maps: Tensor) -> None:
        """Store the features of a keyframe; the content of its map slot is overwritten.

        Args:
            keyframe: with the features of its patches.
            maps: ``(1, 1, C, h, w)`` matching features.
        """
        slot, own = keyframe.map_slot, keyframe.matching.flatten(2).mT
        for level, pooled in zip(self.levels, pool_levels(maps, self.pyramid), strict=True):
            level.keep_map(slot, pooled[0, 0])
        missing = self.capacity - len(self.features)
        if missing:
            first = not len(self.features)
            for name, shape in (("features", own.shape), ("numbers", (*own.shape[:2], 2))):
                empty = (kept := getattr(self, name)).new_zeros(missing, *shape)
                setattr(self, name, empty if first else torch.cat([kept, empty]))
        if self.features.dtype == torch.int8:
            self.features[slot], *numbers = round_channels(own)
            self.numbers[slot] = torch.stack(numbers, -1)
        else:
            self.features[slot] = own

    def __call__(self, coords: Tensor, graph: PatchGraph) -> Correlation:
        """Look up the edges of the window, see :class:`dvo.nets.correlation.correlation.CorrelationLookup`.

        Args:
            coords: ``(1, E, p, p, 2)`` reprojected patch pixels in feature pixels.
            graph: the edges of the window.

        Returns:
            Channels in the order ``pixels_first``.
        """
        m, slots = self.window.per_frame, self.window.map_slots
        maps, kk = slots[graph.jj], slots[graph.ii] * m + graph.kk % m
        features = self.features.flatten(0, 1)
        numbers = self.numbers.flatten(0, 1) if features.dtype == torch.int8 else None
        found = [level.lookup(coords[0], features, kk, maps, numbers)[None] for level in self.levels]
        return Correlation(found, "pixels_first")


def _type_of_maps(model: PatchVO, device: torch.device) -> torch.dtype:
    """Type in which features are looked up; whole numbers where the update operator has layers of these."""
    config = model.config
    if any(isinstance(x, Int8Linear) for x in model.update.modules()) and fits_bytes(
        config.feature_channels, config.radius
    ):
        return torch.uint8
    half = model.precision == torch.bfloat16 and multiplies_bfloat16(device)
    return torch.bfloat16 if half and fits_bfloat16(config.feature_channels) else torch.float32


class PatchWindow:
    """Keyframes and edges of a window with the network that measures them, changed in place.

    Args:
        model: the network.
        window: keyframes and edges; see :meth:`empty`.
        settings: of the measurements.
        device: of the caches.
        sensors: others whose measurements take part in every step.

    Attributes:
        bounds: ``(width, height)`` of the feature map.

    Example:
        >>> window = PatchWindow.empty(model, 24, StepSettings(), device)
        >>> keyframe = window.add(view, len(window), identifier, pose_cw, depth)
        >>> window.connect(len(window) - 1, distances=(1, 2, 3, 5))
        >>> window.update(optimised=8)
    """

    def __init__(
        self,
        model: PatchVO,
        window: Window,
        settings: StepSettings,
        device: torch.device,
        sensors: Sequence[WindowSensor] = (),
    ) -> None:
        self.model, self.window, self.settings, self.device = model, window, settings, device
        self.sensors = tuple(sensors)
        self.correlation = WindowCorrelation(window, model, device)
        self.alignment = None if settings.align == "none" else WindowAlignment(window, settings.alignment, device)
        self.bounds = (0, 0)

    @classmethod
    def empty(cls, model: PatchVO, per_frame: int, settings: StepSettings, device: torch.device) -> PatchWindow:
        """Window without frames.

        Args:
            model: the network.
            per_frame: patches of a frame.
            settings: of the measurements.
            device: of all tensors.
        """
        c = model.config
        return cls(model, Window.empty(per_frame, c.patch_size, c.hidden_channels, device), settings, device)

    def __len__(self) -> int:
        return len(self.window)

    def of_copy(self, window: Window, last: bool) -> PatchWindow:
        """The same for a copy of the window, with caches of its own.

        Args:
            window: with the same frames and edges.
            last: no step will be taken, only measurements aligned that leave the window (:meth:`finalise`).
        """
        shared = {id(self.model): self.model, id(self.window): window, id(self.sensors): self.sensors}
        return deepcopy(self, shared | ({id(self.correlation): self.correlation} if last else {}))

    def insert(self, position: int, keyframe: Keyframe, maps: Tensor, pose_cw: Tensor, patches: Tensor) -> None:
        """Add a keyframe without edges; the positions of those after it increase by one.

        Args:
            position: of the new keyframe.
            keyframe: with its image; its map slot is one that no frame has.
            maps: ``(1, 1, C, h, w)`` matching features of the frame.
            pose_cw: ``(7,)`` world to camera.
            patches: ``(M, 3, p, p)``.
        """
        assert keyframe.image is not None
        self.bounds = maps.shape[-1], maps.shape[-2]
        self.correlation.keep(keyframe, maps)
        if self.alignment is not None:
            self.alignment.keep_image(keyframe.map_slot, keyframe.image)
        self.window.insert(position, keyframe, pose_cw, patches)

    def add(self, view: View, position: int, identifier: int, pose_cw: Tensor, depth: Tensor) -> Keyframe:
        """Add a view as a keyframe without edges.

        Args:
            view: the frame.
            position: of the new keyframe.
            identifier: of the new keyframe.
            pose_cw: ``(7,)`` world to camera.
            depth: ``(1, M)`` inverse depths of its patches.

        Returns:
            The keyframe.
        """
        keyframe = keyframe_of(view, identifier, self.window.free_map_slot())
        patches = patch_coordinates(view.seen.centres, depth, self.model.config.patch_size)[0]
        self.insert(position, keyframe, view.seen.maps, pose_cw, patches)
        return keyframe

    def connect(self, position: int, distances: Collection[int]) -> None:
        """Add edges between a frame and those around it, both ways, and to itself if the network has such.

        Args:
            position: of the frame, which has no edges yet.
            distances: of the frames on either side of it that take part, beside guests, in frames.
        """
        self.window.connect_frame(position, distances, self.model.config.self_edges)

    def try_insert(
        self, view: View, position: int, identifier: int, pose_cw: Tensor, depth: Tensor, policy: InsertPolicy
    ) -> Attempt:
        """Add a frame, measure it, and keep it if its measurements support its pose.

        Args:
            view: the frame.
            position: of the new keyframe; frames after it are solved again.
            identifier: of the new keyframe.
            pose_cw: ``(7,)`` pose to begin with.
            depth: ``(1, M)`` inverse depths to begin with.
            policy: number of updates, and the support that is needed.

        Returns:
            If it was kept; if it was not, everything is as before, bit for bit on the CPU.
        """
        before = self.snapshot()
        self.add(view, position, identifier, pose_cw, depth)
        self.connect(position, policy.distances)
        support = PoseSupport(0.0, 0.0)
        for one in policy.rounds:
            self.update(policy.optimised, one.updates)
            found = [support_of(self.window, k) for k in range(position, position + 1 + policy.later)]
            support = found[0]
            if all(each.reaches(policy.confidence, one.inliers) for each in found):
                return Attempt(True, support)
        if not policy.checked:
            return Attempt(True, support)
        self.window.remove(position)
        self.restore(before)
        return Attempt(False, support)

    def update(self, optimised: int, count: int = 1) -> None:
        """Take steps on the window of an initialised segment.

        Args:
            optimised: number of newest frames whose poses are solved for.
            count: of the steps.
        """
        fixed = self.window.fixed(optimised)
        for _ in range(count):
            self.step(fixed)

    def snapshot(self) -> Snapshot:
        """Record everything that steps and one new frame change, for :meth:`restore`."""
        alignment = None if self.alignment is None else self.alignment.snapshot()
        return Snapshot(self.window.snapshot(), alignment)

    def restore(self, before: Snapshot) -> None:
        """Undo what has changed since a snapshot; the window has the same frames and edges again.

        Args:
            before: the snapshot.
        """
        self.window.restore(before.window)
        if self.alignment is not None and before.alignment is not None:
            self.alignment.restore(before.alignment)

    def finalise(self, edges: Tensor) -> None:
        """Align edges that leave the window, if that is wanted.

        Args:
            edges: ``(e,)`` positions among the edges of the window.
        """
        if self.alignment is not None:
            self.alignment.finalise(edges)

    def state(self) -> UpdateState:
        """State of the window.

        Returns:
            State with a batch dimension of 1.
        """
        w = self.window
        return UpdateState(
            w.edges, w.poses_cw[None], w.patches[None], w.intrinsics[None], w.context[None], w.hidden[None],
            visible=w.visible,
        )  # fmt: skip

    def revise(self) -> Revision:
        """Run the network on the edges of the window, which does not change.

        Returns:
            Output of the network.
        """
        return revise(self.model, self.state(), self.correlation)

    def store(self, revision: Revision) -> None:
        """Store the measurements of a revision as those of the window; poses and depths do not change.

        Args:
            revision: of :meth:`revise`.
        """
        window = self.window
        window.targets, window.weights = revision.targets[0], revision.weights[0]
        window.confidence = revision.weights[0]

    def step(
        self,
        fixed: int,
        damping: BADamping = BADamping(),  # noqa: B008 (frozen)
        structure_only: bool = False,
    ) -> None:
        """Take a step and store its result in the window, see :func:`dvo.models.step.step`.

        Measured depths and the sensors of the window give further factors.

        Args:
            fixed: number of leading poses that stay.
            damping: of bundle adjustment.
            structure_only: all poses stay.
        """
        factors: list[Factor] = [*depth_factors(self.window.measured), *depth_factors(self.window.prior)]
        factors += [factor for sensor in self.sensors for factor in sensor.factors(self.window)]
        blocks = {name: block for sensor in self.sensors for name, block in sensor.blocks(self.window).items()}
        options = BAOptions(
            fixed=fixed, damping=damping, structure_only=structure_only, bounds=self.bounds,
            kernel=self.settings.kernel, depth_range=self._depth_range(),
        )  # fmt: skip
        after = step(self.model, self.state(), self.correlation, options, factors=tuple(factors), blocks=blocks)
        assert after.targets is not None and after.confidence is not None
        window = self.window
        window.poses_cw, window.patches, window.hidden = after.poses_cw[0], after.patches[0], after.hidden[0]
        window.targets, window.weights = after.targets[0], after.confidence[0]
        window.confidence = after.confidence[0]
        for name, values in after.states.items():
            for frame, value in zip(window.frames, values[0], strict=True):
                frame.states[name] = value

    def _depth_range(self) -> tuple[float, float]:
        """Range of inverse depths of the present scene; an accelerator is waited for."""
        patches = self.window.patches
        if not len(patches):
            return DEPTH_RANGE
        middle = patches.shape[-1] // 2
        return depth_range_of(float(patches[:, 2, middle, middle].median()))
