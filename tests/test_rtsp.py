"""``dvo run`` on an RTSP stream that a real sender pushes."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time

import cv2
import imageio_ffmpeg
import numpy as np
import pytest

from tests.support.command_line import summary


@pytest.mark.slow
def test_a_stream_over_rtsp(tmp_path):
    """FFmpeg sends; OpenCV is told to wait for the sender in place of asking a server."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        url = f"rtsp://127.0.0.1:{found.getsockname()[1]}/live"
    wall = np.random.default_rng(0).integers(0, 256, (15, 60, 3), np.uint8)
    wall = cv2.resize(wall, None, fx=8, fy=8, interpolation=cv2.INTER_CUBIC)
    writer = cv2.VideoWriter(str(tmp_path / "clip.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10, (160, 120))
    for k in range(40):
        writer.write(wall[:, 4 * k : 4 * k + 160])
    writer.release()
    (tmp_path / "calib.txt").write_text("140 140 79.5 59.5\n")
    command = [sys.executable, "-m", "dvo", "run", url, "--calib", "calib.txt", "--out", "out", "--queue", "100"]
    options = {"OPENCV_FFMPEG_CAPTURE_OPTIONS": "rtsp_flags;listen|listen_timeout;60|rtsp_transport;tcp"}
    dvo = subprocess.Popen(
        command, cwd=tmp_path, env=os.environ | options, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    send = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-re", "-i", str(tmp_path / "clip.mp4"), "-c", "copy"]
    try:
        for _ in range(60):  # until it listens
            time.sleep(0.5)
            if (
                subprocess.run([*send, "-f", "rtsp", "-rtsp_transport", "tcp", url], timeout=60, check=False).returncode
                == 0
            ):
                break
        said, _ = dvo.communicate(timeout=120)
    finally:
        dvo.kill()
    assert dvo.returncode == 0, said
    written = summary(tmp_path / "out")
    assert written["live"]["received"] >= 30 and written["frames"]["tracked"] >= 20, said
    assert written["source"] == url and written["clock"]["times"] != "fps"
