"""The benchmarks run on the recipe as it is; what they measure is not judged here."""

import pytest
import yaml

from eval.benchmarks.rendering import RECIPE, clip_seconds, step_seconds


@pytest.mark.slow
def test_a_clip_and_a_step_of_the_small_recipe():
    recipe = yaml.safe_load(RECIPE.read_text(encoding="utf-8"))
    seconds, batches = clip_seconds(1, recipe)
    assert seconds > 0 and batches[0]["images"].shape[:2] == (1, 8)
    assert step_seconds(1, recipe, batches) > 0
