"""Files from a training checkpoint: weights to ship, and a state to keep in the repository."""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args

import torch

from dvo.core.command_line import OneLineParser
from dvo.core.errors import DvoError
from dvo.core.text import print_line
from dvo.core.yaml_files import read_text
from dvo.data.files.output import replaced
from dvo.models.weights import save_weights
from train.engine.checkpoint import Which, facts_of, network_of, portable, read_state


def export(arguments: list[str]) -> None:
    """``python -m train export CHECKPOINT OUT [--card FILE] [--which net]``: the moving average of the weights, or
    those in training, as float16 safetensors with a card.

    Raises:
        DvoError: no such checkpoint or card, or one that cannot be read.
    """
    parser = OneLineParser(prog="python -m train export")
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--card", type=Path, help="JSON with further facts for the model card")
    parser.add_argument("--which", choices=get_args(Which), default="average", help="moving average (default) or net")
    options = parser.parse_args(arguments)
    state = read_state(options.checkpoint)
    facts = facts_of(state)
    try:
        json.dumps(facts)
    except (TypeError, ValueError, RecursionError) as error:
        remedy = "give a checkpoint that 'python -m train fit' wrote"
        raise DvoError(f"holds facts that are no text ({error})", file=options.checkpoint, remedy=remedy) from error
    if options.card:
        remedy = "give a JSON object"
        try:
            facts |= json.loads(read_text(options.card, remedy))
        except (ValueError, TypeError, RecursionError) as error:
            raise DvoError(f"is no model card ({error})", file=options.card, remedy=remedy) from error
    save_weights(options.out, network_of(state, options.which, options.checkpoint), facts)
    print_line(f"{options.out}: {facts}")


def export_state(arguments: list[str]) -> None:
    """``python -m train state CHECKPOINT OUT``: a copy that names no folder of this machine.

    Raises:
        DvoError: no such checkpoint, or one that cannot be read.
    """
    parser = OneLineParser(prog="python -m train state")
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("out", type=Path)
    options = parser.parse_args(arguments)
    state = portable(read_state(options.checkpoint))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with replaced(options.out) as part, part.open("wb") as stream:
        torch.save(state, stream)
    print_line(f"{options.out}: step {state['global_step']}")
