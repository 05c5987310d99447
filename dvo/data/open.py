"""Opening of a source: a video, a folder of images, a sequence of a data set, a bag, or a stream."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from dvo.core.arguments import checked_arguments
from dvo.core.errors import DvoError
from dvo.core.text import visible
from dvo.data.calibration.calibration import Calibration
from dvo.data.calibration.focal_guess import guess_focal
from dvo.data.calibration.read import read_calibration
from dvo.data.companions.inertial_source import AUTO, NONE, choose_inertial, imu_calibration_of
from dvo.data.files.files import lookups
from dvo.data.files.stamps import checked_rate
from dvo.data.images.fields import INTERLACED, MOSAIC, are_interlaced, is_mosaic
from dvo.data.images.halves import FLAT, is_panorama, looks_all_around, two_views
from dvo.data.images.image_header import holds_several
from dvo.data.images.reduction import MAX_PIXELS, reduction_to
from dvo.data.inertial_files.imu_calibration import ImuCalibration
from dvo.data.interval import Bound, Interval, expected_frames
from dvo.data.mask import open_masks
from dvo.data.opening import check_invert, check_stride, first_frame, locate, no_calibration
from dvo.data.readers.groundtruth import read_groundtruth
from dvo.data.readers.registry import find_reader
from dvo.data.readers.rosbag import split_topic
from dvo.data.recording import Log, Recording, Request, Selection
from dvo.data.source import Reading, Source
from dvo.data.streams.capture import is_stream, not_found_remedy
from dvo.data.streams.live_source import open_stream


@partial(checked_arguments, skip=("fps", "stride"))
def open_source(
    source: Path | str,
    *,
    calib: Path | str | Calibration | None = None,
    times: Path | str | None = None,
    fps: float | None = None,
    stride: int = 1,
    groundtruth: Path | str | None = None,
    undistort: bool = True,
    reader: str | None = None,
    guess: bool = False,
    queue: int | None = None,
    topic: str | None = None,
    start: Bound | None = None,
    end: Bound | None = None,
    mask: Path | str | None = None,
    mask_invert: bool = False,
    max_pixels: int | None = MAX_PIXELS,
    imu: Path | str = AUTO,
    imu_calib: Path | str | Sequence[Path | str] | ImuCalibration | None = None,
    imu_topic: str | None = None,
) -> Source:
    """Open a video, a folder of images, or a data set's sequence folder (TUM RGB-D, EuRoC, KITTI, TartanAir v1 and v2,
    ICL-NUIM, or an image folder with ``calib.txt`` and ``groundtruth_tum.txt`` beside it), a bag of ROS; or a stream:
    ``webcam:0``, ``rtsp://...``, ``http://...`` or ``-``, see :func:`dvo.data.streams.live_source.open_stream`.

    Relative paths of the options are looked up from the working directory, then from the source's folder, so that
    ``--calib ../calib.txt`` beside an image folder is found from anywhere.

    Args:
        source: path to a file or folder.
        calib: calibration that wins over the dataset's own; see
            :func:`dvo.data.calibration.read.read_calibration`.
        times: file with the time of every image, see :func:`dvo.data.files.clock.clock_of_rows`.
        fps: frames a second, where nothing else gives times; for a video it overrides the container.
        stride: read every ``stride``-th frame.
        groundtruth: TUM trajectory (camera to world), or a format without times for the images of a folder, see
            :func:`dvo.data.readers.groundtruth.read_groundtruth`; wins over the data set's own.
        undistort: resample images, depth and right images to pinhole cameras; otherwise frames carry the distorted
            cameras.
        reader: name of the reader (``dvo.data.readers.registry.READERS``); None: the first whose layout matches.
        guess: where there is no calibration, guess the focal length (:mod:`dvo.data.calibration.focal_guess`), for
            :func:`dvo.calibrate`.
        queue: of a stream, frames that may wait.
        topic: of the images in a bag of ROS, if there are several; ``bag.mcap:/camera/image`` names it too.
        start, end: read from the first of these until before the second: seconds since the first frame, or the number
            of a frame, such as ``"120f"``. Indices and times of the frames stay those of the whole recording, and
            ``stride`` counts from the start. Frames before the start are not decoded; those of a video are, since only
            that finds a frame exactly, but not converted.
        mask: image that is white where the recorded images are used and black where they are ignored, or a folder with
            one for each image (:func:`dvo.data.mask.open_masks`); for ``Frame.mask``.
        mask_invert: white is ignored and black used.
        max_pixels: images with more are reduced by area right after they are decoded, by the smallest whole factor that
            suffices (:mod:`dvo.data.images.reduction`); calibration and masks remain those of the recorded images. None
            for never; streams are never reduced.
        imu: inertial samples for ``Frame.inertial``: ``auto``, those that belong to the recording (in its folder, bag
            or video, or a logger's files beside the video); ``none``; or a file of
            :func:`dvo.data.companions.inertial_source.read_inertial_file`.
        imu_calib: calibration of the inertial sensor that wins over the data set's own, see
            :func:`dvo.data.inertial_files.imu_calibration.read_imu_calibration`.
        imu_topic: of the inertial samples in a bag of ROS, if there are several; two, gyroscope and accelerometer,
            apart by a comma.

    Returns:
        Frames to iterate over; their ``depth``, ``right`` and ``inertial`` are filled where the layout has them.

    Raises:
        DvoError: nothing there, unknown layout, no frame that decodes, no calibration, intrinsics that do not fit the
            images, malformed files.

    Example:
        ::

            source = dvo.open("rgbd_dataset_freiburg1_xyz", stride=2)
            for frame in source:
                print(frame.timestamp, frame.image.shape, frame.depth is not None)
    """
    if is_stream(source):
        given: dict[str, Any] = dict(times=times, groundtruth=groundtruth, reader=reader, topic=topic, start=start)
        given |= dict(imu=None if imu in (AUTO, NONE) else imu, imu_calib=imu_calib, imu_topic=imu_topic)
        for field, value in given.items():
            if value is not None:
                raise DvoError("not for a stream", field=field, remedy="leave it out")
        options: dict[str, Any] = dict(calib=calib, fps=fps, queue=queue, stride=stride, undistort=undistort, end=end)
        return open_stream(source, **options, mask=mask, mask_invert=mask_invert)
    if queue is not None:
        raise DvoError("frames of a recording do not wait", field="queue", remedy="leave it out")
    if source == "":
        raise DvoError("an empty text", field="source", remedy="give a video, a folder of images or a sequence")
    path, topic = split_topic(source, topic)
    with lookups(path):
        is_there = path.exists()
    if not is_there:
        raise DvoError("no such file or folder", file=path, remedy=not_found_remedy(source))
    check_stride(stride)
    check_invert(mask, mask_invert)
    interval = Interval.of(start, end)
    if times is not None and fps is not None:
        raise DvoError("both times and fps are given", field="times", remedy="give --times or --fps, not both")
    request = Request(
        locate(times, path, "times") if times is not None else None,
        checked_rate(fps),
        calib if calib is None or isinstance(calib, Calibration) else read_calibration(locate(calib, path, "calib")),
        topic,
        imu_topic,
        imu_calibration_of(imu_calib, path),
        None if groundtruth is None else locate(groundtruth, path, "groundtruth"),
    )
    with lookups(path):
        recording = find_reader(path, reader).open(path, request)
    if not isinstance(recording, Recording):
        remedy = "derive it from dvo.data.recording.Recording"
        raise DvoError(f"{type(recording).__name__} is no recording", file=path, field="reader", remedy=remedy)
    first = first_frame(recording)
    expected_frames(interval, recording.frame_count, recording.timestamps, path)  # one without frames is an error
    calibration = recording.calibration if request.calibration is None else request.calibration
    height, width = first.image.shape[:2]
    guessed = None
    if calibration is None:
        if not guess:
            raise no_calibration(path, width, height, recording.warnings)
        guessed = guess_focal(recording.images[0] if recording.images else path, width, height)
        calibration = guessed.calibration
    doubts = calibration.doubts(width, height)
    if recording.turned and calibration.readout:  # rows of images are columns of the sensor, or in reverse order
        calibration = replace(calibration, readout=0.0)
        what = "images are" if recording.images else "video is"
        doubts.append(f"the {what} turned by {recording.turned} degrees: the readout of the calibration was not used")
    camera = calibration.camera(width, height)
    halves = two_views(first.image)
    if halves is not None:
        part = "iw/2:ih:0:0" if halves == "side by side" else "iw:ih/2:0:0"
        doubts.append(
            f"the halves of the images look alike, {halves}: if this is stereo, track one of them "
            f"(ffmpeg -vf crop={part})"
        )
    if recording.images and is_panorama(recording.images[0]):
        message = "the file says that it shows all around (equirectangular)"
        if guessed is not None:
            raise DvoError(message, file=recording.images[0], remedy=FLAT.format("IMAGE", ".png"))
        doubts.append(f"{message}: the images are read as those of the calibration")
    elif looks_all_around(first.image):
        name = "IMAGE" if recording.images else "VIDEO"
        remedy = FLAT.format(name, ".png" if recording.images else ".mp4")
        doubts.append(f"the images look as if they showed all around, which dvo does not track: {remedy}")
    if recording.images and holds_several(recording.images[0]):
        doubts.append(
            f"{visible(recording.images[0].name)} holds several images, of which the first is read: take them apart"
        )
    if is_mosaic(first.image):
        doubts.append(MOSAIC)
    elif recording.kind in ("folder", "rosbag") and are_interlaced(raw.image for raw in recording.frames(Log())):
        doubts.append(INTERLACED)
    reduction = reduction_to(max_pixels, width, height)
    size, masks = (width, height), None
    if mask is not None:
        masks = open_masks(locate(mask, path, "mask"), recording, size, mask_invert, reduction)
        if len(masks.files) == 1 and masks(0, None).all():
            name = visible(masks.files[0].name)
            doubts.append(f"the mask {name} ignores no pixel: those that are black (0) would be")
    truth = recording.groundtruth
    if request.groundtruth is not None:
        truth = read_groundtruth(request.groundtruth, recording.timestamps, doubts)
    inertial, told = choose_inertial(recording, imu, request, first.timestamp)
    doubts += told
    try:
        selection = Selection(interval, stride, reduction)
        reading = Reading(
            camera, selection, calibration=calibration, guess=guessed, masks=masks, groundtruth=truth,
            undistort=undistort, doubts=tuple(doubts), inertial=inertial, given=not calibration.was_found,
        )  # fmt: skip
        return Source(recording, reading)
    except DvoError as error:  # the lens model does not know its file
        raise DvoError(error.message, file=calibration.file, field=error.field, remedy=error.remedy) from None
