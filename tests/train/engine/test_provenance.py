"""Training data of weights: counted, kept in states, told by model cards."""

import json

from dvo.models.weights import load_weights
from train.data.clips import Renderings, is_recorded
from train.data.real import RealData
from train.data.stream import ClipStream
from train.engine import export
from train.engine.checkpoint import facts_of, portable, read_state
from train.engine.provenance import KEY, Material, Provenance, material_of, names_of


def test_renderings_alone_are_under_the_licence_of_the_code():
    found = Provenance().after(3, Material()).after(2, Material()).facts()
    assert found == {"licence": "MIT", "data": "renderings of dvo.synth only", "rendered_clips": 5}
    assert Provenance().data() == "none"


def test_recordings_are_named_and_bring_their_licence():
    mixed = Provenance(rendered=4).after(1, Material(("kitti",))).after(2, Material(("kitti", "a")))
    assert mixed.facts() == {
        "licence": "as the recordings allow",
        "data": "renderings of dvo.synth (4 clips); recordings a, kitti (3 clips)",
        "rendered_clips": 4,
        "recorded_clips": 3,
        "recordings": ["a", "kitti"],
    }
    assert mixed.after(1, Material(("a",))).recorded == 4


def test_photographs_and_unknown_clips_are_told():
    painted = Provenance().after(1, Material(photographs="holidays"))
    assert "photographs of holidays" in painted.data() and painted.licence() == "as the photographs allow"
    other = painted.after(2, Material(other="MyClips"))
    assert "clips of MyClips (2 clips)" in other.data()
    assert other.licence() == "as the photographs allow and the training data allow"
    assert material_of(object(), 0, 1) == Material(other="object")
    assert ClipStream().material(0) == Material(other="ClipStream")


def test_starting_weights_are_told_with_their_card():
    free = Provenance.of_weights(load_weights("small")).after(1, Material())
    assert free.start["name"] == "small" and len(free.start["sha256"]) == 64
    assert free.facts()["started_from"]["card"]["licence"] == "MIT" == free.licence()
    for card, theirs in (({"origin": "DPVO checkpoint"}, "not known"), ({"licence": "CC BY-NC"}, "CC BY-NC")):
        bound = Provenance(start={"name": "x", "card": card}).after(1, Material(("a",)))
        assert bound.licence() == f"as the recordings allow and the starting weights allow ({theirs})"


def test_a_record_survives_a_state():
    record = Provenance(2, 1, 0, ("a", "b"), ("p",), (), {"name": "x", "card": {"hours": 3}})
    assert Provenance.of_state(json.loads(json.dumps({KEY: record.to_dict()}))) == record


def test_old_states_have_seen_renderings_only():
    assert Provenance.of_state({"global_step": 7, "Renderings": {"clips_seen": 9}}) == Provenance(rendered=9)
    assert Provenance.of_state({"global_step": 7}) == Provenance()


def test_names_tell_folders_apart_and_no_more(tmp_path):
    assert names_of([str(tmp_path / "a"), f"{tmp_path}/b/"]) == ("a", "b")
    assert names_of([str(tmp_path / "x" / "P1"), str(tmp_path / "y" / "P1")]) == ("x/P1", "y/P1")
    assert names_of([str(tmp_path / "a"), str(tmp_path / "a")]) == ("a",) and names_of([]) == ()


def test_clips_know_whether_they_are_recorded(tmp_path):
    data = Renderings(batch_size=2, seed=3, real=RealData(str(tmp_path / "kitti"), share=0.5))
    found = [bool(data.material(clip, processes=2).recordings) for clip in range(64)]
    assert found == [is_recorded(3, clip // 4, data.real) for clip in range(64)] and 8 < sum(found) < 56
    assert data.material(found.index(True), 2) == Material(("kitti",))
    assert Renderings(textures=str(tmp_path / "mine")).material(0) == Material(photographs="mine")
    assert Renderings().material(0) == Material()
    assert data.summary() == "from the recordings kitti in 50% of the batches" and Renderings().summary() == "rendered"


def test_a_leg_on_recordings_is_told_after_further_legs(tmp_path, runs, monkeypatch):
    """Exported after a leg on renderings that follows the one on recordings."""
    runs.fit(tmp_path, 1)
    with monkeypatch.context() as patched:
        patched.setattr(Renderings, "material", lambda *_: Material(("secret",)))
        runs.fit(tmp_path, 2, runs.module(), tmp_path / "last.ckpt")
    runs.fit(tmp_path, 4, runs.module(), tmp_path / "last.ckpt")
    state = read_state(tmp_path / "last.ckpt")
    assert facts_of(portable(state)) == facts_of(state)
    export.export([str(tmp_path / "last.ckpt"), str(tmp_path / "w.safetensors")])
    card = load_weights(tmp_path / "w.safetensors").info.card
    assert card["data"] == "renderings of dvo.synth (3 clips); recordings secret (1 clip)"
    assert card["licence"] == "as the recordings allow" and card["recordings"] == ["secret"]
