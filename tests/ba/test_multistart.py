"""Bundle adjustment from several starts: reversed reliefs and motions of another body are left, and nothing else."""

from dataclasses import replace

import pytest
import torch

from dvo.ba.multistart import (
    AS_THEY_ARE,
    COLD_STARTS,
    DEPTH_STARTS,
    OPTIONS,
    PRESENT,
    RESTARTS,
    Solution,
    clearly_lower,
    equal_depths,
    mirrored,
    multistart,
    preferred,
    present,
)
from dvo.ba.patch_problem import PatchProblem
from dvo.core.errors import DvoError
from dvo.geometry import se3
from dvo.geometry.projection import reproject


def scene(seed: int, shift: float = 0.15, rotation: float = 0.04, moving: float = 0.0):
    """Eight frames that see 60 points in front of the first ones; the share ``moving`` of the points goes its own way.

    Returns:
        True poses ``(8, 7)``, and the problem at its true values.
    """
    generator = torch.Generator().manual_seed(seed)
    twists = torch.randn(8, 6, generator=generator, dtype=torch.float64) * torch.tensor([shift] * 3 + [rotation] * 3)
    twists[0] = 0
    poses = se3.exp(twists)
    depth = 0.5 + torch.rand(60, generator=generator, dtype=torch.float64)
    centres = torch.rand(60, 2, generator=generator, dtype=torch.float64) * torch.tensor([80.0, 60.0])
    patches = torch.cat([centres, depth[:, None]], 1)[..., None, None]
    intrinsics = torch.tensor([70.0, 70, 40, 30], dtype=torch.float64).expand(8, 4)
    kk = torch.arange(60).repeat_interleave(8)
    ii, jj = kk // 20, torch.arange(8).repeat(60)
    kk, ii, jj = (x[ii != jj] for x in (kk, ii, jj))
    targets = reproject(poses[None], patches[None], intrinsics[None], ii, jj, kk).coords[0, :, 0, 0]
    walk = torch.tensor([1.5, 0.4], dtype=torch.float64) * (jj - ii)[:, None]
    targets = targets + walk * (kk % 20 < 20 * moving)[:, None]
    targets = targets + 0.05 * torch.randn(targets.shape, generator=generator, dtype=torch.float64)
    return poses, PatchProblem(poses, patches, intrinsics, targets, torch.ones_like(targets), ii, jj, kk)


def rotation_error(problem, truth):
    return float(se3.log(se3.relative(truth, problem.poses_cw))[:, 3:].norm(dim=1).max())


def solved_from(problem, start):
    """Solution of a start."""
    (found,) = multistart(problem, {start: RESTARTS[start]})
    return found


@pytest.mark.parametrize("seed", range(4))
def test_a_reversed_relief_is_left(seed):
    poses, problem = scene(seed, shift=0.06)
    wrong = solved_from(problem, "reversed")
    assert rotation_error(wrong.problem, poses) > 0.02  # a minimum of its own: iterations do not lead out of it
    found = multistart(wrong.problem, RESTARTS)
    best = preferred(found)
    assert best is found[0] and best.start in DEPTH_STARTS and rotation_error(best.problem, poses) < 0.01
    assert best.cost < 0.5 * wrong.cost
    assert [solution.cost for solution in found] == sorted(solution.cost for solution in found)


@pytest.mark.parametrize("seed", range(4))
def test_the_right_solution_is_kept(seed):
    _, problem = scene(seed)
    assert preferred(multistart(problem, RESTARTS)).start == PRESENT


@pytest.mark.parametrize("seed", range(4))
def test_the_motion_of_a_moving_body_is_left(seed):
    """Poses that follow a body with a third of the points, and depths that suit these poses."""
    poses, problem = scene(seed, moving=0.35)
    along = poses.clone()
    along[:, 0] += torch.arange(8) * 0.02
    weights = torch.where((problem.kk % 20 < 7)[:, None], 1.0, 0.01).to(poses).expand(-1, 2)
    wrong = solved_from(problem.with_values(poses_cw=along, weights=weights), "equal").problem
    assert rotation_error(wrong, poses) > 0.02
    options = replace(OPTIONS, solver=replace(OPTIONS.solver, max_iterations=30))
    best = preferred(multistart(wrong.with_values(weights=problem.weights), RESTARTS, options))
    assert best.start != PRESENT and rotation_error(best.problem, poses) < 0.7 * rotation_error(wrong, poses)


@pytest.mark.parametrize("seed", range(4))
def test_a_problem_is_solved_from_nothing(seed):
    """From one pose for all frames, up to scale; the first pose stays where it is."""
    poses, problem = scene(seed, shift=0.1)
    moved = se3.compose(poses, se3.exp(torch.tensor([0.3, 0, 0.1, 0.2, 0, 0])).double().expand_as(poses))
    nothing = problem.with_values(poses_cw=moved[:1].expand_as(moved), inverse_depths=torch.full((60,), 3.0))
    best = multistart(nothing, COLD_STARTS)[0]
    torch.testing.assert_close(best.problem.poses_cw[0], moved[0])
    assert rotation_error(best.problem, moved) < 0.02


@pytest.mark.parametrize("start", DEPTH_STARTS)
def test_a_near_scene_keeps_its_depths(start):
    """The same problem in another unit, in which it is thirty times as near: the usual bound would hold all depths."""
    poses, problem = scene(0)
    near = poses.clone()
    near[:, :3] /= 30
    there = problem.with_values(poses_cw=near, inverse_depths=30 * problem.inverse_depths)
    found, usual = (solved_from(given, start).problem.inverse_depths for given in (there, problem))
    assert float(found.median()) == pytest.approx(30 * float(usual.median()), rel=0.05)
    assert float(found.max()) > 30.0


def test_a_solution_has_to_be_clearly_better():
    _, problem = scene(0)
    costs = {PRESENT: 1.0, "a": 0.96, "b": 2.0}
    found = sorted((Solution(name, problem, cost) for name, cost in costs.items()), key=lambda s: s.cost)
    assert preferred(found).start == PRESENT
    assert preferred([Solution("c", problem, 0.9), *found]).start == "c"
    assert preferred([found[0], found[2]]).start == "a"  # without a present solution
    assert clearly_lower(0.9, 1.0) and not clearly_lower(0.96, 1.0) and not clearly_lower(float("nan"), 1.0)


def test_a_start_that_leads_nowhere_is_abandoned():
    _, problem = scene(0)

    def far(now, options):
        return now.with_values(inverse_depths=torch.full_like(now.inverse_depths, 1e-3))

    names = [[s.start for s in multistart(problem, {"far": far, PRESENT: present}, abandon=x)] for x in (2.0, 1e9)]
    assert names == [[PRESENT], [PRESENT, "far"]]


class Given:
    """Work for another thread, which has begun it, or has not when it is taken back."""

    def __init__(self, work, has_begun):
        self.outcome, self.work, self.asked = work() if has_begun else None, work, 0

    def withdraw(self):
        return self.outcome is None

    def result(self):
        assert self.outcome is not None
        self.asked += 1
        return self.outcome


@pytest.mark.long
@pytest.mark.parametrize("starts", [RESTARTS, DEPTH_STARTS, {PRESENT: present, **COLD_STARTS}], ids=len)
@pytest.mark.parametrize("begun", [(True, True), (True, False), (False, False)])
def test_solutions_are_the_same_with_a_part_beside(starts, begun):
    _, problem = scene(3, moving=0.3)
    for options in (OPTIONS, AS_THEY_ARE):
        given = []

        def beside(work, given=given):
            given.append(Given(work, begun[len(given)]))
            return given[-1]

        plain, found = multistart(problem, starts, options), multistart(problem, starts, options, beside=beside)
        assert [(one.start, one.cost) for one in found] == [(one.start, one.cost) for one in plain]
        for one, other in zip(found, plain, strict=True):
            assert torch.equal(one.problem.poses_cw, other.problem.poses_cw)
            assert torch.equal(one.problem.patches, other.problem.patches)
        assert [one.asked for one in given] == [int(k) for k in begun]


def test_starts_are_positive_and_keep_the_median():
    depths = torch.tensor([0.01, 0.5, 1.0, 1.5, 40.0]).view(5, 1, 1)
    assert mirrored(depths).flatten().tolist() == pytest.approx([1.99, 1.5, 1.0, 0.5, 0.1])
    _, problem = scene(0)
    median = problem.inverse_depths.median()
    for start in DEPTH_STARTS.values():
        values = start(problem, OPTIONS).inverse_depths
        assert (values > 0).all() and values.median() == pytest.approx(float(median), rel=0.05)
    assert (equal_depths(problem, OPTIONS).inverse_depths == median).all()


@pytest.mark.parametrize("start", COLD_STARTS)
@pytest.mark.parametrize("name", ["kk", "jj"])
def test_a_problem_with_an_index_out_of_range_is_refused(start, name):
    _, problem = scene(0)
    wrong = problem.with_values(**{name: getattr(problem, name) + 1000})
    with pytest.raises(DvoError, match=name):
        multistart(wrong, {start: COLD_STARTS[start]}, AS_THEY_ARE)
