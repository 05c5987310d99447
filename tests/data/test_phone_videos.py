"""Videos as phones record them: 10 bits, HDR, grey, variable rate, sound, turned."""

import subprocess

import cv2
import imageio_ffmpeg
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data import Calibration, open_source

WIDTH, HEIGHT, COUNT, FPS = 160, 120, 12, 20
CALIB = Calibration(100, 100, 79.5, 59.5)
PORTRAIT = Calibration(100, 100, 59.5, 79.5)
SILENT_X265 = ("-x265-params", "log-level=error")
TEN_BITS = ("-pix_fmt", "yuv420p10le")


def picture(index):
    """RGB: a gradient in steps of 16 columns, each channel with a slope of its own, and a square that moves."""
    grey = np.tile(np.repeat(np.linspace(16, 232, WIDTH // 16), 16), (HEIGHT, 1))
    image = np.stack([grey, 0.8 * grey + 20, 0.5 * grey + 60], axis=-1)
    image[20:60, 16 + 4 * index : 56 + 4 * index] = [200, 60, 90]
    return image.round().astype(np.uint8)


PICTURES = [picture(index) for index in range(COUNT)]


def ffmpeg(*arguments, data=b""):
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", *map(str, arguments)]
    done = subprocess.run(command, input=data, capture_output=True)
    assert done.returncode == 0, done.stderr.decode(errors="replace")


def encode(file, *options, inputs=(), pictures=PICTURES):
    """Write the pictures as a video at FPS; ``inputs`` are further ones, ``options`` those of the output."""
    head = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{WIDTH}x{HEIGHT}", "-r", FPS, "-i", "-")
    ffmpeg(*head, *inputs, *options, file, data=b"".join(image.tobytes() for image in pictures))
    return file


def differences(frames, pictures=PICTURES):
    """Mean absolute difference of each frame to its picture, grey levels."""
    assert [frame.image.shape for frame in frames] == [image.shape for image in pictures]
    assert all(frame.image.dtype == np.uint8 for frame in frames)
    return [np.abs(f.image.astype(float) - image).mean() for f, image in zip(frames, pictures, strict=True)]


FORMS = {
    "h264.mp4": ("-c:v", "libx264", "-crf", 10, "-pix_fmt", "yuv420p"),
    "h264 10 bits.mp4": ("-c:v", "libx264", "-crf", 10, *TEN_BITS),
    "hevc 10 bits.mp4": ("-c:v", "libx265", *SILENT_X265, "-crf", 10, "-tag:v", "hvc1", *TEN_BITS),
    "full range.mov": ("-vf", "scale=out_range=pc", "-c:v", "libx264", "-crf", 10, "-pix_fmt", "yuv420p"),
}


@pytest.mark.parametrize("name", FORMS)
def test_colours_and_times(tmp_path, name):
    source = open_source(encode(tmp_path / name, *FORMS[name]), calib=CALIB)
    frames = list(source)
    assert len(source) == len(frames) == COUNT and source.warnings == []
    assert [frame.timestamp for frame in frames] == pytest.approx(np.arange(COUNT) / FPS)
    # 8-bit 4:2:0 loses colour at the edges of the square; exchanged channels or another range are beyond 10 levels
    assert max(differences(frames)) < 3
    assert np.mean(np.abs(frames[5].image[..., ::-1].astype(float) - PICTURES[5])) > 10


@pytest.mark.parametrize("pixels", ["gray", "gray10le"])
@pytest.mark.parametrize("codec", ["libx264", "ffv1"])
def test_grey(tmp_path, codec, pixels):
    quality = ("-crf", 10) if codec == "libx264" else ()
    file = encode(tmp_path / "grey.mkv", "-c:v", codec, "-pix_fmt", pixels, *quality)
    frames = list(open_source(file, calib=CALIB))
    assert len(frames) == COUNT
    grey = [np.repeat((image @ [0.299, 0.587, 0.114])[..., None], 3, axis=2) for image in PICTURES]
    assert max(differences(frames, grey)) < 2


def hlg_as_sdr(levels):
    """Levels of HLG on an SDR display: BT.2100 with the peak of 1000 cd/m2, reference white 203 cd/m2, gamma 2.4."""
    signal = levels / 255
    scene = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - 0.55991073) / 0.17883277) + 0.28466892) / 12)
    return 255 * np.clip(1000 / 203 * scene**1.2, 0, 1) ** (1 / 2.4)


@pytest.mark.slow
def test_hdr_of_phones(tmp_path):
    """HEVC of 10 bits, BT.2020, HLG: newer FFmpeg takes reference white for white, older leaves the levels."""
    random, steps = np.random.default_rng(0), np.linspace(0, 255, WIDTH // 8).round()
    rows = [np.repeat(random.permutation(steps), 8) for _ in range(2)]  # halves of the picture that are not alike
    ramp = np.repeat(rows, HEIGHT // 2, axis=0)
    pictures = [np.repeat(ramp[..., None], 3, axis=2).astype(np.uint8)] * COUNT
    tags = "setparams=color_primaries=bt2020:color_trc=arib-std-b67:colorspace=bt2020nc"
    filters = f"scale=out_color_matrix=bt2020nc:out_range=tv,{tags}"
    options = ("-vf", filters, "-c:v", "libx265", *SILENT_X265, "-crf", 4, "-tag:v", "hvc1", *TEN_BITS)
    source = open_source(encode(tmp_path / "hlg.mov", *options, pictures=pictures), calib=CALIB)
    frames = list(source)
    assert len(frames) == COUNT and source.warnings == []
    assert {(frame.image.shape, frame.image.dtype.name) for frame in frames} == {((HEIGHT, WIDTH, 3), "uint8")}
    found = frames[5].image[4::8, 4::8].astype(float)
    errors = [np.abs(found - levels[4::8, 4::8, None]).max() for levels in (hlg_as_sdr(ramp), ramp)]
    assert min(errors) < 6
    assert np.abs(hlg_as_sdr(ramp) - ramp).max() > 40  # the two are not the same


@pytest.mark.parametrize("container", ["mp4", "mov", "mkv", "webm"])
def test_variable_rate(tmp_path, container):
    """Times are the presentation times, and the number of frames that a container only estimates is no fault."""
    codec = ("-c:v", "libvpx", "-crf", 4, "-b:v", "4M") if container == "webm" else ("-c:v", "libx264", "-crf", 10)
    index = np.arange(COUNT)
    times = 0.03 * index + 0.01 * index**2  # gaps of 40 to 250 ms
    options = ("-vf", "settb=1/1000,setpts='(0.03*N+0.01*N*N)/TB'", "-fps_mode", "passthrough")
    rest = ("-enc_time_base", "1/1000", *codec, "-pix_fmt", "yuv420p")
    source = open_source(encode(tmp_path / f"v.{container}", *options, *rest), calib=CALIB)
    frames = list(source)
    assert [frame.timestamp for frame in frames] == pytest.approx(times, abs=1.1e-3)
    assert max(differences(frames)) < 6  # every frame is that of its time
    assert source.warnings == []


def test_a_variable_rate_does_not_hide_that_a_file_was_cut(tmp_path):
    options = ("-vf", "settb=1/1000,setpts='(0.03*N+0.01*N*N)/TB'", "-fps_mode", "passthrough")
    file = encode(tmp_path / "v.mkv", *options, "-enc_time_base", "1/1000", "-c:v", "mjpeg", "-q:v", 2)
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 6 // 10])
    source = open_source(file, calib=CALIB)
    assert 4 <= len(list(source)) < COUNT
    assert "cut short" in source.warnings[-1]


def test_the_number_of_frames_of_a_matroska_file_that_begins_late(tmp_path):
    """As a recording of a stream: what the file states is its end."""
    source = open_source(encode(tmp_path / "a.mkv", "-c:v", "mjpeg", "-output_ts_offset", 3600), calib=CALIB)
    assert source.frame_count == COUNT == len(list(source)) and not source.warnings


def test_a_video_that_begins_late_counts_from_its_first_frame(tmp_path):
    options = ("-vf", "settb=1/1000,setpts='(3+0.03*N+0.01*N*N)/TB'", "-fps_mode", "passthrough")
    file = encode(tmp_path / "late.mp4", *options, "-enc_time_base", "1/1000", "-c:v", "libx264", "-pix_fmt", "yuv420p")
    index = np.arange(COUNT)
    times = [frame.timestamp for frame in open_source(file, calib=CALIB)]
    assert times == pytest.approx(0.03 * index + 0.01 * index**2, abs=1.1e-3)


@pytest.mark.parametrize("order", [("0:v", "1:a"), ("1:a", "0:v")], ids=["after", "before"])
def test_sound_is_ignored(tmp_path, order):
    options = FORMS["h264.mp4"]
    silent = list(open_source(encode(tmp_path / "silent.mp4", *options), calib=CALIB))
    tone = ("-f", "lavfi", "-i", "sine=frequency=440:duration=2")  # longer than the images
    maps = [part for stream in order for part in ("-map", stream)]
    source = open_source(encode(tmp_path / "sound.mp4", *maps, *options, "-c:a", "aac", inputs=tone), calib=CALIB)
    frames = list(source)
    assert len(source) == COUNT and source.warnings == []
    assert [frame.timestamp for frame in frames] == [frame.timestamp for frame in silent]
    assert all(np.array_equal(a.image, b.image) for a, b in zip(frames, silent, strict=True))


@pytest.mark.parametrize("container", ["mp4", "mov", "mkv", "webm"])
@pytest.mark.parametrize("flip", [None, "-display_hflip", "-display_vflip"])
def test_turned_and_mirrored(tmp_path, container, flip):
    """Frames are what ffmpeg shows; OpenCV's own turning takes mirrored frames for others."""
    codec = ("-c:v", "libvpx", "-crf", 4, "-b:v", "4M") if container == "webm" else FORMS["h264.mp4"]
    plain = encode(tmp_path / f"plain.{container}", *codec)
    for clockwise in (0, 90, 180, 270):
        file = tmp_path / f"{clockwise}.{container}"
        turning = ("-display_rotation", -clockwise, *([flip] if flip else []))  # its angles are counter-clockwise
        ffmpeg(*turning, "-i", plain, "-c", "copy", file)
        ffmpeg("-i", file, "-frames:v", 1, tmp_path / "shown.png")
        shown = cv2.cvtColor(cv2.imread(str(tmp_path / "shown.png")), cv2.COLOR_BGR2RGB)
        source = open_source(file, calib=PORTRAIT if clockwise in (90, 270) else CALIB)
        frame = next(iter(source)).image
        assert frame.shape == shown.shape and np.abs(frame.astype(float) - shown).mean() < 3
        assert ["mirror" in warning for warning in source.warnings] == [True] * (flip is not None)
        assert flip or source.turned == clockwise


def spherical(version):
    """The box by which a track says that it shows all around: Google's first version, in XML, and the second."""

    def box(kind, content):
        return (len(content) + 8).to_bytes(4) + kind + content

    if version == 1:
        return box(b"uuid", bytes.fromhex("ffcc8263f8554a938814587a02521fdd") + b"<rdf:SphericalVideo/>")
    projection = box(b"proj", box(b"prhd", bytes(16)) + box(b"equi", bytes(20)))
    return box(b"sv3d", box(b"svhd", bytes(5)) + projection)


@pytest.mark.parametrize("version", [1, 2])
def test_videos_that_show_all_around_are_said(tmp_path, version):
    file = encode(tmp_path / "v.mp4", *FORMS["h264.mp4"])
    data, box = bytearray(file.read_bytes()), spherical(version)
    around = [b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"avc1"][: 2 if version == 1 else 7]
    places = [data.index(name, data.index(b"moov")) - 4 for name in around]
    end = places[-1] + int.from_bytes(data[places[-1] : places[-1] + 4])
    for at in places:  # the index follows the frames, whose places stay
        data[at : at + 4] = (int.from_bytes(data[at : at + 4]) + len(box)).to_bytes(4)
    file.write_bytes(data[:end] + box + data[end:])
    with pytest.raises(DvoError, match="show all around.*v360=e:flat"):
        open_source(file, guess=True)
    source = open_source(file, calib=CALIB)
    assert len(list(source)) == COUNT and "show all around" in " ".join(source.warnings)


@pytest.mark.parametrize("container", ["mp4", "mkv"])
def test_two_videos_in_a_file_are_said(tmp_path, container):
    """Front and rear cameras, or colour and depth, in one file."""
    front = encode(tmp_path / "front.mp4", *FORMS["h264.mp4"])
    rear = encode(tmp_path / "rear.mp4", *FORMS["h264.mp4"], pictures=[image[:, ::-1] for image in PICTURES])
    both = tmp_path / f"both.{container}"
    ffmpeg("-i", front, "-i", rear, "-map", "0:v", "-map", "1:v", "-c", "copy", both)
    source = open_source(both, calib=CALIB)
    assert max(differences(list(source))) < 3
    assert (
        f"holds 2 videos, of which the first is read: another one is ffmpeg -i both.{container}" in source.warnings[0]
    )
    assert open_source(front, calib=CALIB).warnings == []


def test_whole_files_are_not_said_to_be_cut(tmp_path):
    """Matroska and FLV state a duration, which is that of longer sound, or begins before the first image."""
    silent = encode(tmp_path / "silent.mp4", *FORMS["h264.mp4"])
    sound = ("-f", "lavfi", "-i", "sine=frequency=440:duration=2")
    ffmpeg("-i", silent, *sound, "-c:v", "copy", "-c:a", "pcm_s16le", tmp_path / "sound.mkv")
    ffmpeg("-i", silent, "-c", "copy", tmp_path / "silent.flv")
    for name in ("sound.mkv", "silent.flv"):
        source = open_source(tmp_path / name, calib=CALIB)
        assert len(list(source)) == COUNT and "cut short" not in " ".join(source.warnings)
    data = (tmp_path / "sound.mkv").read_bytes()
    (tmp_path / "cut.mkv").write_bytes(data[: len(data) // 6])
    source = open_source(tmp_path / "cut.mkv", calib=CALIB)
    assert len(list(source)) < COUNT and "cut short" in " ".join(source.warnings)


def test_the_pattern_of_the_colours_of_a_gif_is_not_interlaced(tmp_path):
    texture = np.random.default_rng(1).integers(0, 256, (HEIGHT // 8, WIDTH // 8, 3), dtype=np.uint8)
    moving = [np.roll(texture.repeat(8, 0).repeat(8, 1), 3 * index, 1) for index in range(COUNT)]
    rows = [np.where(np.arange(HEIGHT)[:, None, None] % 2, image, 255 - image).astype(np.uint8) for image in moving]
    assert open_source(encode(tmp_path / "a.gif", pictures=rows), calib=CALIB).warnings == []
    assert (
        "interlaced" in open_source(encode(tmp_path / "a.mkv", "-c:v", "ffv1", pictures=rows), calib=CALIB).warnings[0]
    )


@pytest.mark.parametrize("name", ["12:30:05.mp4", "file:clip.mp4", "-c.mp4", "100%.mp4", "a%03d.mp4", "a|b\nc.mp4"])
def test_names_that_mean_something_to_ffmpeg(tmp_path, monkeypatch, name):
    encode(tmp_path / "v.mp4", *FORMS["h264.mp4"]).rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert len(list(open_source(name, calib=CALIB))) == COUNT


def test_a_codec_that_is_not_decoded_is_named(tmp_path):
    file = encode(tmp_path / "v.mp4", *FORMS["h264.mp4"])
    data = file.read_bytes()
    file.write_bytes(data.replace(b"avc1", b"qqqq").replace(b"avcC", b"qqqC"))
    with pytest.raises(DvoError, match=r"decode.*qqqq.*-c:v libx264|does not decode"):
        open_source(file, calib=CALIB)


def test_trimmed_videos_are_whole_and_cut_ones_are_not(tmp_path):
    pictures = [picture(index % 20) for index in range(60)]
    options = ("-c:v", "libx264", "-g", 60, "-pix_fmt", "yuv420p", "-movflags", "faststart")
    whole = encode(tmp_path / "whole.mp4", *options, pictures=pictures)
    for start, length in (("0.7", ()), ("1.2", ("-t", "1.1"))):
        trimmed = tmp_path / f"{start}.mov"
        ffmpeg("-ss", start, "-i", whole, *length, "-c", "copy", trimmed)
        source = open_source(trimmed, calib=CALIB)
        count = len(list(source))
        assert abs(source.frame_count - count) <= 2 and source.warnings == []
    data = whole.read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) * 7 // 10])
    source = open_source(tmp_path / "cut.mp4", calib=CALIB)
    assert len(list(source)) < 50 and "cut short or damaged" in " ".join(source.warnings)


@pytest.mark.parametrize(
    ("aspect", "calibration", "size"),
    [
        ("4/3", None, (213, 120)),
        ("4/3", Calibration(100, 100, 100, 60), (213, 120)),
        ("4/3", Calibration(75, 100, 80, 60), (160, 120)),
        ("4/3", Calibration(75, 100, 80, 60, width=160, height=120), (160, 120)),
        ("8/9", Calibration(100, 100, 80, 67, width=160, height=135), (160, 135)),
        ("1/1", Calibration(100, 100, 80, 60), (160, 120)),
    ],
)
def test_pixels_that_are_not_square(tmp_path, aspect, calibration, size):
    file = encode(tmp_path / "wide.mp4", "-vf", f"setsar={aspect}", "-c:v", "libx264", "-pix_fmt", "yuv420p")
    source = open_source(file, calib=calibration, guess=True)
    assert (source.camera.width, source.camera.height) == size
    assert all(frame.image.shape[1::-1] == size for frame in source)
    assert any("not square" in warning for warning in source.warnings) == (size != (WIDTH, HEIGHT))


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_names_that_are_no_utf8(tmp_path, suffix):
    plain = encode(tmp_path / f"plain{suffix}", "-c:v", "libx264", "-pix_fmt", "yuv420p")
    for name in (b"vid\xe9o", b"\xff\xfe/clip\xe9"):
        file = tmp_path / (name + suffix.encode()).decode("utf-8", "surrogateescape")
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(plain.read_bytes())
        source = open_source(file, calib=CALIB)
        assert len(list(source)) == COUNT
        source.name.encode("utf-8")


@pytest.mark.parametrize(("stack", "words"), [(np.hstack, "side by side"), (np.vstack, "one above the other")])
def test_two_views_in_one_video(tmp_path, stack, words):
    noise = np.random.default_rng(1).integers(0, 256, (HEIGHT // 8, WIDTH // 8 + 8, 3), dtype=np.uint8)
    texture = noise.repeat(8, 0).repeat(8, 1)
    views = [texture[:, shift : shift + WIDTH] for shift in (0, 6)]
    pictures = [stack(views)] * 3
    file, size = tmp_path / "stereo.mp4", pictures[0].shape
    ffmpeg("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[1]}x{size[0]}", "-r", FPS, "-i", "-", "-c:v", "libx264",
           "-crf", 10, "-pix_fmt", "yuv420p", file, data=b"".join(image.tobytes() for image in pictures))  # fmt: skip
    assert words in " ".join(open_source(file, guess=True).warnings)
    assert not any("look alike" in text for text in open_source(encode(tmp_path / "a.mp4"), guess=True).warnings)


@pytest.mark.parametrize("top_first", [True, False])
@pytest.mark.parametrize("flagged", [True, False])
def test_interlaced_videos_are_said(tmp_path, top_first, flagged):
    """Some versions of OpenCV do not convert frames that the codec marks as interlaced, and return what they like."""
    texture = np.random.default_rng(1).integers(0, 256, (HEIGHT // 8, WIDTH // 4, 3), dtype=np.uint8)
    texture = texture.repeat(8, 0).repeat(8, 1)
    moments = [texture[:, 3 * index : 3 * index + WIDTH].copy() for index in range(24)]
    for first, second in zip(moments[::2], moments[1::2], strict=True):
        first[int(top_first) :: 2] = second[int(top_first) :: 2]
    fields = ("-flags", "+ildct+ilme", "-vf", f"setfield={'tff' if top_first else 'bff'}") if flagged else ()
    file = encode(tmp_path / "camcorder.mp4", *fields, *FORMS["h264.mp4"], pictures=moments[::2])
    try:
        warnings = " ".join(open_source(file, calib=CALIB).warnings)
    except DvoError as error:
        assert flagged and "interlaced" in str(error) and "bwdif" in str(error)
    else:
        assert "interlaced" in warnings and "bwdif" in warnings


def test_pictures_of_an_interlaced_video_are_said(tmp_path):
    for index in range(8):
        still = np.random.default_rng(1).integers(0, 256, (15, 60), dtype=np.uint8).repeat(8, 0).repeat(8, 1)
        image = still[:, 6 * index : 6 * index + WIDTH].copy()
        image[1::2] = still[1::2, 6 * index + 3 : 6 * index + 3 + WIDTH]
        assert cv2.imwrite(str(tmp_path / f"{index}.png"), image)
    assert "bwdif" in " ".join(open_source(tmp_path, calib=CALIB, fps=25).warnings)
