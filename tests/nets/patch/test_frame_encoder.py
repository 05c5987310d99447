"""The encoder as a module of its own gives the features that the network itself uses."""

import torch

from dvo.models.patch_vo import PatchVO
from dvo.nets.patch.config import ModelConfig, preset
from dvo.nets.patch.patchifier import normalise_images


def check(config):
    torch.manual_seed(0)
    model = PatchVO(config).eval()
    images = torch.randint(0, 256, (2, 3, 48, 64), dtype=torch.uint8)
    centres = torch.tensor([[[3, 4], [9, 7]], [[5, 2], [12, 9]]])[None]
    with torch.no_grad():
        found = dict(zip(model.encoder.names, model.encoder(images), strict=True))
        features = model.patchify.encode(normalise_images(images)[None])
        patches, context = model.patchify.cut(features, centres)
    torch.testing.assert_close(found["matching"], features.matching[0])
    frame = torch.tensor([0, 0, 1, 1])
    x, y = centres.reshape(-1, 2).unbind(1)
    torch.testing.assert_close(found["context"][frame, :, y, x], context[0])
    torch.testing.assert_close(found["matching"][frame, :, y, x], patches[0, :, :, 1, 1])
    assert not any(name.startswith("encoder") for name in model.state_dict())


def test_shared_encoder():
    check(preset("tiny"))


def test_two_encoders():
    check(ModelConfig(8, 16, 32, 48, shared_encoder=False, training_patches=12))


def test_parameters_are_those_of_the_network():
    model = PatchVO(preset("tiny"))
    sum(part.sum() for part in model.encoder(torch.zeros(1, 3, 32, 32))).backward()
    assert model.patchify.fnet.conv1.weight.grad is not None and model.encoder.training
    assert not model.eval().encoder.training
