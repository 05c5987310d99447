"""Mean absolute inverse depth of the patches as a term of the loss: what is near costs."""

from torch import Tensor

from dvo.models.patch_vo import UpdateState


def nearness(state: UpdateState, truth: object) -> Tensor:
    """Scalar."""
    return state.patches[:, :, 2].abs().mean()
