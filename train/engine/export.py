"""Write shipped weights from a training checkpoint: the moving average, as float16 safetensors with a card."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch

from dvo.models.patch_vo import PatchVO
from dvo.models.weights import save_weights
from dvo.nets.config import preset


def averaged_model(checkpoint: Path) -> tuple[PatchVO, dict[str, object]]:
    """The moving average in a checkpoint, and facts about it."""
    state = torch.load(checkpoint, map_location="cpu", weights_only=False)  # our own file: Lightning's, with objects
    settings = state["hyper_parameters"]
    model = PatchVO(preset(settings["model"]))
    prefix = "average."
    model.load_state_dict({k.removeprefix(prefix): v for k, v in state["state_dict"].items() if k.startswith(prefix)})
    facts = {
        "steps": state["global_step"],
        "clips": state.get("Renderings", {}).get("clips_seen"),
        "seed": settings["seed"],
        "preset": settings["model"],
        "licence": "MIT",
        "data": "renderings of dvo.synth only",
    }
    return model, facts


def main(arguments: list[str]) -> None:
    """``python -m train export CHECKPOINT OUT [--card FILE]``."""
    parser = argparse.ArgumentParser(prog="python -m train export")
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--card", type=Path, help="JSON with further facts for the model card")
    options = parser.parse_args(arguments)
    model, facts = averaged_model(options.checkpoint)
    if options.card:
        facts |= json.loads(options.card.read_text(encoding="utf-8"))
    save_weights(options.out, model.eval(), facts)
    print(f"{options.out}: {facts}")
