"""The learned odometry: a streaming tracker over a sliding patch graph (DPVO 3.4).

For each frame: features and patches; a guess of its pose; edges between its patches and the recent frames, both ways;
one recurrent update; bundle adjustment of the window; and, a few frames later, the decision whether it was worth
keeping. What leaves the window is written down once and never changes again.
"""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import torch
from torch import Tensor

from dvo.ba.cold_start import COLD_UPDATES, damping_at, robust_cost, solve_from_nothing
from dvo.ba.layer import BAOptions, bundle_adjust
from dvo.data.frame import Frame
from dvo.errors import DvoError
from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.graph.window import Keyframe, Window
from dvo.models.patch_vo import PatchVO
from dvo.models.weights import load_weights
from dvo.nets.edge_correlation import EdgeCorrelation
from dvo.nets.patchifier import normalise_images, patch_coordinates, pool_levels, random_centres
from dvo.odometry.chronicle import Chronicle
from dvo.odometry.config import TRACKER_PRESETS, TrackerConfig
from dvo.odometry.motion import flow_magnitude, parallax, predict_pose
from dvo.odometry.protocol import Estimate, Result, Status
from dvo.odometry.working_image import working_image


class PatchOdometry:
    """Tracks one sequence with :class:`dvo.models.patch_vo.PatchVO`.

    Args:
        model: the network; moved to ``device`` and used in evaluation mode.
        config: see :class:`TrackerConfig`.
        seed: of the patch centres. The same seed on the same machine gives the same trajectory, bit for bit on the
            CPU with a fixed number of threads.
        device: where to compute.
        name: how reports call it.
    """

    def __init__(
        self,
        model: PatchVO,
        config: TrackerConfig,
        *,
        seed: int = 0,
        device: torch.device | str = "cpu",
        name: str = "dvo",
    ) -> None:
        self.name = name
        self.config = config
        self.device = torch.device(device)
        self.model = model.to(self.device).eval()
        self.seed = seed
        self._generator = torch.Generator().manual_seed(seed)
        c = model.config
        self.window = Window.empty(config.patches, c.patch_size, c.hidden_channels, self.device)
        # Sides leave room for several pixels of motion before a window must be fetched again.
        self._correlations = [
            EdgeCorrelation(scale, c.patch_size**2, c.radius, 14 if scale == 1 else 12, self.device)
            for scale in c.pyramid
        ]
        self._bounds = (0, 0)  # width and height of the feature map
        self._chronicle = Chronicle()
        self._count = 0
        self._initialised = False
        self._blind = 0
        self._size: tuple[int, int] | None = None
        self._info: dict[str, object] = {}

    # -- streaming -----------------------------------------------------------------------------------------------

    @torch.inference_mode()
    def track(self, frame: Frame) -> Estimate:
        """Take the next frame.

        Raises:
            DvoError: a timestamp that does not increase, or an image of another size than the first.
        """
        self._check(frame)
        keyframe, coordinates = self._observe(frame)
        window, config = self.window, self.config
        pose = predict_pose(window.poses_cw, [f.timestamp for f in window.frames], frame.timestamp,
                            config.motion_damping)  # fmt: skip
        window.append(keyframe, pose, coordinates)
        self._connect()
        if not self._initialised and len(window) > 1 and self._probe() < config.initial_motion:
            return self._skip(frame)
        record = self._chronicle.add(frame.timestamp, keyframe.identifier)
        before = window.poses_cw, window.patches, window.hidden, window.weights
        if self._initialised:
            searching = 0 < self._blind <= config.patience
            for _ in range(config.search_updates if searching else config.updates):
                self._update()
        elif len(window) >= config.initial_frames:
            self._initialise()
        confidence = self._confidence()
        record.lost = lost = self._initialised and confidence < config.lost_confidence
        pose_wc = self._pose_wc(len(window) - 1)
        self._blind = self._blind + 1 if lost else 0
        if 0 < self._blind <= config.patience:
            # Nothing is known of this frame: it must not stand between those before it and those to come.
            window.poses_cw, window.patches, window.hidden, window.weights = before
            window.remove(len(window) - 1)
            record.anchor = window.frames[-1].identifier
        else:
            self._reduce()
        status = Status.LOST if lost else Status.TRACKING if self._initialised else Status.INITIALISING
        return Estimate(frame.timestamp, pose_wc, status, confidence)

    @torch.inference_mode()
    def finish(self) -> Result:
        """Refine the last window and write the trajectory of every frame."""
        window, config = self.window, self.config
        if len(window) > 1:
            for age in range(config.final_updates if self._initialised else config.initial_updates):
                self._update(COLD_UPDATES if self._initialised else age)
        while len(window):
            self._settle()
        trajectory, read = self._chronicle.trajectory(), len(self._chronicle.frames)
        info = {
            **self._info, "keyframes": self._chronicle.keyframes, "seed": self.seed, "initialised": self._initialised,
            "config": asdict(config),
        }  # fmt: skip
        return Result(trajectory, self._chronicle.map(), read, read - len(trajectory), info)

    # -- steps of a frame ----------------------------------------------------------------------------------------

    def _check(self, frame: Frame) -> None:
        past = self._chronicle.frames
        if past and frame.timestamp <= past[-1].timestamp:
            raise DvoError(
                f"time {frame.timestamp} does not come after {past[-1].timestamp}",
                field=f"frame {frame.index}",
                remedy="give frames in order of time",
            )
        size = (frame.image.shape[1], frame.image.shape[0])
        if self._size is not None and self._size != size:
            raise DvoError(
                f"is {size[0]}x{size[1]}, the frames before are {self._size[0]}x{self._size[1]}",
                field=f"frame {frame.index}",
                remedy="give frames of one size",
            )
        self._size = size

    def _observe(self, frame: Frame) -> tuple[Keyframe, Tensor]:
        """Features and patches of a frame."""
        config, net = self.config, self.model
        image, camera = working_image(frame, config.pixels)
        self._info = {"working_size": [camera.width, camera.height], "working_intrinsics": camera.intrinsics.tolist()}
        rgb = torch.from_numpy(image).to(self.device).permute(2, 0, 1)
        features = net.patchify.encode(normalise_images(rgb)[None, None])
        h, w = features.matching.shape[-2:]
        centres = random_centres(1, config.patches, h, w, self._generator).to(self.device)
        matching, context = net.patchify.cut(features, centres)
        slot = self.window.free_slot()
        self._bounds = (w, h)
        for cache, level in zip(self._correlations, pool_levels(features.matching, net.config.pyramid), strict=True):
            cache.keep_map(slot, level[0, 0])
        x, y = (centres[0, 0] * net.config.STRIDE).unbind(-1)
        colors = rgb[:, y.clamp(max=camera.height - 1), x.clamp(max=camera.width - 1)].T.cpu()
        intrinsics = torch.tensor(camera.intrinsics / net.config.STRIDE, dtype=torch.float32, device=self.device)
        keyframe = Keyframe(self._count, frame.timestamp, slot, matching[0], context[0], colors, intrinsics)
        self._count += 1
        depth = torch.ones(1, config.patches, device=self.device)
        if self._initialised:
            depth *= self.window.patches[-3 * config.patches :, 2, 0, 0].median()
        return keyframe, patch_coordinates(centres, depth, net.config.patch_size)[0]

    def _connect(self) -> None:
        """Join recent patches with the newest frame, and its patches with recent frames."""
        m, n = self.config.patches, len(self.window)
        first = max(0, n - 1 - self.config.lifetime)
        device = self.device
        old = torch.arange(first * m, (n - 1) * m, device=device)
        slots = [self.window.connect(old, torch.full_like(old, n - 1))]
        new = torch.arange((n - 1) * m, n * m, device=device)
        targets = torch.arange(first, n if self.model.config.self_edges else n - 1, device=device)
        slots.append(self.window.connect(new.repeat_interleave(len(targets)), targets.repeat(m)))
        for correlation in self._correlations:
            correlation.forget(torch.cat(slots))

    def _revise(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Run the network on all edges: hidden state, flow revision, confidence, current patch centres."""
        window, net = self.window, self.model
        graph = window.graph
        coords = reproject(
            window.poses_cw[None], window.patches[None], window.intrinsics[None], graph.ii, graph.jj, graph.kk
        ).coords
        frames = window.frames
        matching = torch.cat([f.matching for f in frames]).flatten(2)
        context = torch.cat([f.context for f in frames])
        slots = torch.tensor([f.slot for f in frames], device=self.device)[graph.jj]
        correlation = [
            cache.lookup(coords[0], window.slots, matching, graph.kk, slots)[None] for cache in self._correlations
        ]
        hidden, delta, weights = net.update(
            window.hidden[None], context[graph.kk][None], correlation, graph, pixels_first=True
        )
        centre = net.config.patch_size // 2
        return hidden[0], delta[0], weights[0], coords[0, :, centre, centre]

    def _update(self, age: int = COLD_UPDATES) -> None:
        """One revision of the edges and of the newest poses and their depths; ``age`` counts the updates so far."""
        window, config = self.window, self.config
        window.hidden, delta, window.weights, centres = self._revise()
        n = len(window)
        fixed = max(1, n - config.optimisation) if self._initialised else 1
        result = bundle_adjust(
            window.poses_cw[None],
            window.patches[None],
            window.intrinsics[None],
            (centres + delta)[None],
            window.weights[None],
            window.ii,
            window.jj,
            window.kk,
            BAOptions(fixed=fixed, damping=damping_at(age), bounds=self._bounds),
        )
        window.poses_cw, window.patches = result.poses_cw[0], result.patches[0]

    def _probe(self) -> float:
        """Median revision of the flow from the last keyframe to the newest frame, if poses did not change."""
        window, n = self.window, len(self.window)
        _, delta, _, _ = self._revise()
        edges = (window.ii == n - 2) & (window.jj == n - 1)
        return float(delta[edges].norm(dim=-1).median())

    def _skip(self, frame: Frame) -> Estimate:
        """Before initialisation: a frame that shows too little motion shares the pose of the keyframe before it."""
        self.window.remove(len(self.window) - 1)
        self._chronicle.add(frame.timestamp, self.window.frames[-1].identifier)
        return Estimate(frame.timestamp, self._pose_wc(len(self.window) - 1), Status.INITIALISING)

    def _initialise(self) -> None:
        """Optimise the first window; it counts as initialised once there is parallax."""
        for age in range(self.config.initial_updates):
            self._update(age)
            if age == self.config.initial_updates // 2:
                self._begin_again()
        window, n = self.window, len(self.window)
        seen = parallax(window, 0, n - 1)
        if n > self.config.initial_frames:
            seen = max(seen, parallax(window, n // 2, n - 1))
        self._initialised = seen >= self.config.initial_parallax

    def _begin_again(self) -> None:
        """Solve the first window from nothing with the flow as now seen, and keep what explains it better."""
        window = self.window
        _, delta, weights, centres = self._revise()
        seen = ((centres + delta)[None], weights[None], window.ii, window.jj, window.kk)
        intrinsics = window.intrinsics[None]
        poses, patches, cost = solve_from_nothing(window.patches[None], intrinsics, *seen, bounds=self._bounds)
        if cost < robust_cost(window.poses_cw[None], window.patches[None], intrinsics, *seen):
            window.poses_cw = se3.normalise(se3.compose(poses[0], window.poses_cw[0]))
            window.patches = patches[0]

    def _reduce(self) -> None:
        """Drop the keyframe that adds nothing, and what is too old."""
        window, config = self.window, self.config
        n = len(window)
        back = config.keyframe_index
        if self._initialised and n > back + 1:
            i, j = n - back - 1, n - back + 1
            if (flow_magnitude(window, i, j) + flow_magnitude(window, j, i)) / 2 < config.keyframe_motion:
                self._drop(n - back)
        window.keep(window.ii >= len(window) - config.removal)
        limit = config.removal + config.lifetime if self._initialised else config.initial_frames + 4
        while len(window) > limit:
            self._settle()

    def _drop(self, index: int) -> None:
        """Remove a keyframe; its frames hang on the one before it from now on."""
        window = self.window
        relative = se3.relative(window.poses_cw[index - 1], window.poses_cw[index]).double().cpu().numpy()
        anchor, oldest = window.frames[index - 1].identifier, window.frames[0].identifier
        self._chronicle.rehang(window.remove(index).identifier, anchor, relative, oldest)

    def _settle(self) -> None:
        """The oldest keyframe leaves the window: its pose and points are final."""
        window, centre = self.window, self.model.config.patch_size // 2
        frame, pose = window.frames[0], window.poses_cw[0]
        x, y, d = window.patches[: self.config.patches, :, centre, centre].unbind(-1)
        fx, fy, cx, cy = frame.intrinsics
        rays = torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(x)], dim=-1)
        world = se3.act(se3.inverse(pose), rays / d[:, None])
        near = (d > 0.05 * d.median()).cpu().numpy()  # a far point's depth is a guess
        self._chronicle.add_points(world.float().cpu().numpy()[near], frame.colors.numpy()[near])
        self._chronicle.settle(frame.identifier, pose.double().cpu().numpy())
        window.remove(0)

    def _confidence(self) -> float:
        newest = self.window.weights[self.window.jj == len(self.window) - 1]
        return float(newest.mean()) if len(newest) else 0.0

    def _pose_wc(self, index: int) -> np.ndarray:
        return se3.inverse(self.window.poses_cw[index]).double().cpu().numpy()


def load(
    weights: str = "small",
    *,
    device: torch.device | str = "cpu",
    seed: int = 0,
    config: TrackerConfig | None = None,
    **overrides: object,
) -> PatchOdometry:
    """The learned odometry, ready to track one sequence.

    Args:
        weights: name of weights that ship with dvo, or a file.
        device: where to compute.
        seed: see :class:`PatchOdometry`.
        config: settings; None takes those of the preset.
        overrides: single settings, by the names of :class:`TrackerConfig`.

    Raises:
        DvoError: no such weights, or a file that is none; an unknown setting.
    """
    loaded = load_weights(weights, device)
    config = config or TRACKER_PRESETS.get(loaded.preset, TrackerConfig())
    if overrides:
        TrackerConfig.from_dict(dict(overrides))
        config = replace(config, **overrides)  # type: ignore[arg-type]
    return PatchOdometry(loaded.model, config, seed=seed, device=device, name=f"dvo-{loaded.name}")
