import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.sensors.depth import read_depth

TRUTH = np.array([[1.0, 2.5, np.nan], [0.002, np.nan, 12.0]], np.float32)


def write(path, kind):
    raw = np.nan_to_num(TRUTH)
    if kind == "npy":
        np.save(path.with_suffix(".npy"), np.where(np.isnan(TRUTH), np.inf, TRUTH))
    elif kind == "npz":
        np.savez(path.with_suffix(".npz"), depth=raw)
    elif kind == "packed":
        cv2.imwrite(str(path.with_suffix(".png")), np.ascontiguousarray(raw).view(np.uint8).reshape(2, 3, 4))
    elif kind == "float":
        cv2.imwrite(str(path.with_suffix(".tiff")), raw)
    else:
        integers = np.rint(raw * 5000)
        integers[1, 1] = 65535  # the other mark of what is not known
        cv2.imwrite(str(path.with_suffix(".png")), integers.astype(np.uint16))
    return next(path.parent.glob(f"{path.name}.*"))


@pytest.mark.parametrize("kind", ["npy", "npz", "packed", "float", "integers"])
def test_encodings(tmp_path, kind):
    depth = read_depth(write(tmp_path / "d", kind), 5000)
    assert depth.dtype == np.float32 and np.allclose(depth, TRUTH, atol=1e-6, equal_nan=True)


def test_integers_need_a_unit(tmp_path):
    file = write(tmp_path / "d", "integers")
    assert read_depth(file, 1000)[0, 0] == pytest.approx(5)
    with pytest.raises(DvoError, match="without a unit") as caught:
        read_depth(file)
    assert caught.value.file == file and caught.value.field == "depth_scale"


@pytest.mark.parametrize("damage", ["missing", "empty", "cut png", "cut npy", "cut npz"])
def test_files_that_cannot_be_decoded_give_none(tmp_path, damage):
    file = write(tmp_path / "d", {"cut npy": "npy", "cut npz": "npz"}.get(damage, "integers"))
    data = file.read_bytes()
    file.write_bytes(b"" if damage == "empty" else data[: len(data) // 2])
    if damage == "missing":
        file.unlink()
    assert read_depth(file, 5000) is None


def test_pictures_are_no_depth(tmp_path):
    cv2.imwrite(str(tmp_path / "colour.png"), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(DvoError, match="are no depth"):
        read_depth(tmp_path / "colour.png", 5000)
    np.save(tmp_path / "cube.npy", np.ones((2, 2, 2), np.float32))
    with pytest.raises(DvoError, match="shape"):
        read_depth(tmp_path / "cube.npy")
    np.savez(tmp_path / "other.npz", distance=TRUTH)
    with pytest.raises(DvoError, match="no array 'depth'"):
        read_depth(tmp_path / "other.npz")
