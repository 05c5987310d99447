"""Calibration files as other programs write them: what is read of each, and what is refused."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data import read_calibration
from dvo.geometry.undistort import project

KC = (0.1, -0.2, 0.003, 0.004)
FIVE = (*KC, 0.05)
EIGHT = (*FIVE, 0.06, 0.07, 0.08)
MATRIX = "[500, 0, 320, 0, 510, 240, 0, 0, 1]"
ROWS = "[[500, 0, 320], [0, 510, 240], [0, 0, 1]]"
PINHOLE = "fx: 500\nfy: 510\ncx: 320\ncy: 240\n"
GYROFLOW = {
    "camera_model": "HERO9 Black", "lens_model": "Wide", "calib_dimension": {"w": 640, "h": 480}, "digital_lens": None,
    "frame_readout_time": 15.0, "input_horizontal_stretch": 1.0, "input_vertical_stretch": 1.0, "asymmetrical": False,
    "fisheye_params": {"RMS_error": 0.4, "camera_matrix": [[500, 0, 320], [0, 510, 240], [0, 0, 1]],
                       "distortion_coeffs": KC, "radial_distortion_limit": None},
}  # fmt: skip
SLAM = """%YAML:1.0

#--------------------------------------------------------------------------------------------
# Camera Parameters. Adjust them!
#--------------------------------------------------------------------------------------------

# Camera calibration and distortion parameters (OpenCV)
Camera.fx: 500.0
Camera.fy: 510.0
Camera.cx: 320.0
Camera.cy: 240.0
Camera.k1: 0.1
Camera.k2: -0.2
Camera.p1: 0.003
Camera.p2: 0.004
Camera.k3: 0.05
Camera.width: 640
Camera.height: 480
Camera.fps: 30.0
Camera.RGB: 1
ThDepth: 40.0
DepthMapFactor: 5000.0
ORBextractor.nFeatures: 1000
ORBextractor.scaleFactor: 1.2
Viewer.KeyFrameSize: 0.05
Viewer.PointSize:2
Viewer.CameraSize:\t0.08
"""
STEREO = """
LEFT.height: 480
LEFT.width: 640
LEFT.D: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data:[-0.28, 0.07, 0.0002, 1.8e-05, 0.0]
LEFT.K: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [458.654, 0.0, 367.215, 0.0, 457.296, 248.375, 0.0, 0.0, 1.0]
RIGHT.D: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data:[-0.28, 0.07, 0.0002, 1.8e-05, 0.0]
RIGHT.K: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [457.587, 0.0, 379.999, 0.0, 456.134, 255.238, 0.0, 0.0, 1]
"""
SLAM3 = """%YAML:1.0
File.version: "1.0"
Camera.type: "KannalaBrandt8"
Camera1.fx: 190.9
Camera1.fy: 190.8
Camera1.cx: 254.9
Camera1.cy: 256.8
Camera1.k1: 0.003
Camera1.k2: 0.0007
Camera1.k3: -0.002
Camera1.k4: 0.0002
Camera2.fx: 190.4
Camera2.fy: 190.3
Camera2.cx: 252.5
Camera2.cy: 254.9
Camera2.k1: 0.003
Camera2.k2: 0.001
Camera2.k3: -0.002
Camera2.k4: 0.0003
Stereo.T_c1_c2: !!opencv-matrix
  rows: 4
  cols: 4
  dt: f
  data: [1.0, 0, 0, -0.1, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0]
Camera.width: 512
Camera.height: 512
IMU.T_b_c1: !!opencv-matrix
  rows: 4
  cols: 4
  dt: f
  data: [1.0, 0, 0, -0.1, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0]
IMU.NoiseGyro: 0.00016
"""
RECTIFIED = """%YAML:1.0
Camera.type: "Rectified"
Camera1.fx: 500.
Camera1.fy: 510.
Camera1.cx: 320.
Camera1.cy: 240.
Camera.width: 640
Camera.height: 480
Camera.newWidth: 600
Camera.newHeight: 350
Stereo.ThDepth: 40.0
Stereo.b: 0.0745
"""
VSLAM = """Camera:
  name: "EuRoC monocular"
  setup: "monocular"
  model: "{}"
  fx: 500
  fy: 510
  cx: 320
  cy: 240
  k1: 0.1
  k2: -0.2
  {}
  fps: 20.0
  cols: 640
  rows: 480
  color_order: "Gray"
Feature:
  name: "default ORB feature extraction setting"
  scale_factor: 1.2
Preprocessing:
  min_size: 800
"""
VINS = """%YAML:1.0
---
model_type: {}
camera_name: camera
image_width: 640
image_height: 480
{}
"""
VINS_PINHOLE = VINS.format("PINHOLE", """distortion_parameters:
   k1: 0.1
   k2: -0.2
   p1: 0.003
   p2: 0.004
projection_parameters:
   fx: 500
   fy: 510
   cx: 320
   cy: 240
fisheye: 0
min_dist: 30 # min distance between two features""")  # fmt: skip
VINS_MEI = VINS.format("MEI", """mirror_parameters:
   xi: 1.9
distortion_parameters:
   k1: 0.1
   k2: -0.2
   p1: 0.003
   p2: 0.004
projection_parameters:
   gamma1: 900
   gamma2: 910
   u0: 320
   v0: 240
fisheye: 1""")  # fmt: skip
VINS_KB = VINS.format("KANNALA_BRANDT", """projection_parameters:
   k2: 0.01
   k3: -0.02
   k4: 0.003
   k5: 0.004
   mu: 300
   mv: 301
   u0: 320
   v0: 240""")  # fmt: skip
OST = """# oST version 5.0 parameters


[image]

width
640

height
480

[narrow_stereo]

camera matrix
500.000000 0.000000 320.000000
0.000000 510.000000 240.000000
0.000000 0.000000 1.000000

distortion
0.1 -0.2 0.003 0.004 0.05

rectification
1.000000 0.000000 0.000000
0.000000 1.000000 0.000000
0.000000 0.000000 1.000000

projection
480.000000 0.000000 320.000000 0.000000
0.000000 490.000000 240.000000 0.000000
0.000000 0.000000 1.000000 0.000000
"""
XML = """<?xml version="1.0"?>
<opencv_storage>
<calibration_time>"Mon 5 May"</calibration_time>
<image_width>640</image_width>
<image_height>480</image_height>
<flags>0</flags>
{}<camera_matrix type_id="opencv-matrix">
  <rows>3</rows><cols>3</cols><dt>d</dt>
  <data>500. 0. 320. 0. 510. 240. 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix">
  <rows>{}</rows><cols>1</cols><dt>d</dt>
  <data>
    {}</data></distortion_coefficients>
<avg_reprojection_error>1.9e-01</avg_reprojection_error>
<per_view_reprojection_errors type_id="opencv-matrix">
  <rows>4</rows><cols>1</cols><dt>f</dt><data>0.1 0.2 0.3 0.4</data></per_view_reprojection_errors>
</opencv_storage>
"""
INFO = """header: {{seq: 0, stamp: {{secs: 1, nsecs: 2}}, frame_id: "camera"}}
height: 480
width: 640
distortion_model: "{}"
{}: {}
{}: [500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0]
{}: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
{}: [480.0, 0.0, 320.0, 0.0, 0.0, 490.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
roi: {{x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: False}}
---
"""
OKVIS = """%YAML:1.0
cameras:
     - {T_SC: [1.0, 0, 0, 0.1, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0],
        image_dimension: [640, 480],
        distortion_coefficients: [0.1, -0.2, 0.003, 0.004],
        distortion_type: radialtangential,
        focal_length: [500, 510],
        principal_point: [320, 240]}
     - {T_SC: [1.0, 0, 0, 0.2, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0],
        image_dimension: [640, 480],
        distortion_coefficients: [0, 0, 0, 0],
        distortion_type: radialtangential,
        focal_length: [1, 1],
        principal_point: [1, 1]}
camera_params:
     camera_rate: 20
"""
NCAMERA = """label: "rig"
cameras:
- camera:
    label: cam0
    image_height: 480
    image_width: 640
    type: pinhole
    intrinsics:
      cols: 1
      rows: 4
      data: [500, 510, 320, 240]
    distortion:
      type: equidistant
      parameters:
        cols: 1
        rows: 4
        data: [0.1, -0.2, 0.003, 0.004]
  T_B_C:
    cols: 4
    rows: 4
    data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
"""
KITTI_RAW = """calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
S_00: 1.392000e+03 5.120000e+02
K_00: 9.842439e+02 0 6.900000e+02 0 9.808141e+02 2.331966e+02 0 0 1
D_00: -3.728755e-01 2.037299e-01 2.219027e-03 1.383707e-03 -7.233722e-02
R_00: 1 0 0 0 1 0 0 0 1
S_rect_00: 1.242000e+03 3.750000e+02
P_rect_00: 7.215377e+02 0 6.095593e+02 0 0 7.215377e+02 1.728540e+02 0 0 0 1 0
"""


def basalt(kind, **intrinsics):
    camera = {"camera_type": kind, "intrinsics": {"fx": 158.0, "fy": 157.0, "cx": 254.0, "cy": 256.0, **intrinsics}}
    other = {"camera_type": kind, "intrinsics": {"fx": 1.0, "fy": 1.0, "cx": 2.0, "cy": 2.0, **intrinsics}}
    value = {"T_imu_cam": [{"px": 0.1, "py": 0, "pz": 0, "qx": 0, "qy": 0, "qz": 0, "qw": 1}] * 2,
             "intrinsics": [camera, other], "resolution": [[512, 512], [640, 480]],
             "calib_accel_bias": [0.1] * 9, "imu_update_rate": 200.0, "vignette": []}  # fmt: skip
    return json.dumps({"value0": value})


def transforms(frames=({},), **values):
    rows = [{"file_path": f"images/{n}.png", "transform_matrix": np.eye(4).tolist(), **frame}
            for n, frame in enumerate(frames)]  # fmt: skip
    return json.dumps({**values, "aabb_scale": 16, "frames": rows})


MIDDLEBURY = """cam0=[500 0 320; 0 510 240; 0 0 1]
cam1=[500 0 {}; 0 510 240; 0 0 1]
doffs={}
baseline=193.001
width=640
height=480
ndisp=280
isint=0
vmin=31
dyavg=0
"""
REALSENSE = """Intrinsic Parameters:

 Intrinsic of "Depth" / 640x480 / {{Z16}}
  Width:      \t640
  Height:     \t480
  PPX:        \t324.033264160156
  PPY:        \t233.439270019531
  Fx:         \t390.25830078125
  Fy:         \t390.25830078125
  Distortion: \tBrown Conrady
  Coeffs:     \t0  \t0  \t0  \t0  \t0
  FOV (deg):  \t78.7 x 63.17

 Intrinsic of "Color" / 640x480 / {{YUYV/RGB8/BGR8/RGBA8/BGRA8/Y8}}
  Width:      \t640
  Height:     \t480
  PPX:        \t320
  PPY:        \t240
  Fx:         \t500
  Fy:         \t510
  Distortion: \t{}
  Coeffs:     \t{}
  FOV (deg):  \t70.07 x 43.05

Extrinsic from "Depth"\t  To\t  "Color" :
 Rotation Matrix:
   0.99982          0.0182547        0.00521857
"""
SHOWN = "[ 640x480  p[320 240]  f[500 510]  {} [0.1 -0.2 0.003 0.004 0.05] ]"
BOUGUET = """% Intrinsic and Extrinsic Camera Parameters
%-- Focal length:
fc = [ 500.000000000000000 ; 510.000000000000000 ];
cc = [ 320.000000000000000 ; 240.000000000000000 ];
alpha_c = {};
kc = [ 0.1 ; -0.2 ; 0.003 ; 0.004 ; 0.05 ];
fc_error = [ 0.35 ; 0.37 ];
kc_error = [ 0.002 ; 0.011 ; 0.0001 ; 0.0001 ; 0.0 ];
nx = 640;
ny = 480;
n_ima = 20;\t\t% Number of calibration images
est_dist = [ 1 ; 1 ; 1 ; 1 ; 0 ];\t% Estimation indicator of the distortion coefficients
%-- Image #1:
omc_1 = [ -7.925019e-001 ; 5.895213e-001 ; 1.453934e+000 ];
Tc_1  = [ 1.796143e+002 ; -6.509156e+001 ; 8.940399e+002 ];
"""
STEREO_BOUGUET = """fc_left = [ 500 ; 510 ];
cc_left = [ 320 ; 240 ];
alpha_c_left = 0;
kc_left = [ 0.1 ; -0.2 ; 0.003 ; 0.004 ; 0.05 ];
fc_right = [ 400 ; 410 ];
cc_right = [ 321 ; 241 ];
kc_right = [ 0 ; 0 ; 0 ; 0 ; 0 ];
T = [ -99.84929   0.82221 ...
      0.43647 ];
"""
MATLAB = {"RadialDistortion": [0.1, -0.2, 0.05], "TangentialDistortion": [0.003, 0.004], "ImageSize": [480, 640],
          "WorldUnits": "mm", "EstimateSkew": 0, "NumRadialDistortionCoefficients": 3, "Version": "9.1",
          "EstimateTangentialDistortion": True,
          "IntrinsicMatrix": [[500, 0, 0], [0, 510, 0], [321, 241, 1]]}  # fmt: skip
DISPLAYED = """
  cameraIntrinsics with properties:

             FocalLength: [500 510]
          PrincipalPoint: [321 241]
               ImageSize: [480 640]
        RadialDistortion: [0.1000 -0.2000]
    TangentialDistortion: [0 0]
                    Skew: 0
                       K: [3x3 double]
"""


def meshroom(version, kind, parameters, camera=(), **more):
    intrinsic = {"intrinsicId": "2390361049", "width": "640", "height": "480", "sensorWidth": "32",
                 "sensorHeight": "24", "type": kind, "principalPoint": ["320", "240"], "pxFocalLength": "500",
                 "distortionParams": [str(value) for value in parameters], **dict(camera)}  # fmt: skip
    view = {"viewId": "1", "intrinsicId": "2390361049", "path": "a.jpg", "metadata": {"Exif:f": "5"}}
    return json.dumps({"version": version.split("."), "views": [view], "intrinsics": [intrinsic], **more})


def openmvg(*cameras):
    """As cereal writes them: the name of a type with its first camera alone."""
    written, types = [], {}
    for key, (name, data) in enumerate(cameras):
        number = types.setdefault(name, len(types) + 1)
        is_first = number == len(types) and name not in [one for one, _ in cameras[:key]]
        value = {"polymorphic_id": number + (2**31 if is_first else 0)} | (
            {"polymorphic_name": name} if is_first else {}
        )
        written.append({"key": key, "value": {**value, "ptr_wrapper": {"id": 2**31 + key, "data": data}}})
    return json.dumps({"sfm_data_version": "0.3", "root_path": "", "views": [], "intrinsics": written, "structure": []})


LATER = {"focalLength": "25", "principalPoint": ["0", "0"], "pixelRatio": "1.02"}
MVG = {"width": 640, "height": 480, "focal_length": 500.0, "principal_point": [320.0, 240.0]}
SQUARE = (500, 500, 320, 240)
NUMBERS = (500, 510, 320, 240)
FULL = {"fl_x": 500, "fl_y": 510, "cx": 320.5, "cy": 240.5, "w": 640, "h": 480}
MRCAL = """# made with mrcal
{{
    'lensmodel':  'LENSMODEL_{}',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 500, 510, 320, 240,{}],

    'extrinsics': [ 0, 0.78, -0, -0, -0, -0,],

    'imagersize': [ 640, 480,],
}}
"""
ZED = """[LEFT_CAM_HD]
fx=700
fy=701
cx=640.5
cy=360.5
{}
[RIGHT_CAM_HD]
fx=702
fy=703
cx=641.5
cy=361.5
k1=0.2
[STEREO]
Baseline=119.905
CV_HD=0.00697667
Name=unknown
"""
ZED_NUMBERS = (700, 701, 640.5, 360.5)
METASHAPE = """<?xml version="1.0" encoding="UTF-8"?>
<calibration>
  <projection>{}</projection>
  <width>640</width>
  <height>480</height>
  <f>510</f>
  <cx>0.5</cx>
  <cy>0.5</cy>
  <b1>-10</b1>
  <k1>0.1</k1>
  <k2>-0.2</k2>
  {}
  <date>2020-01-01T00:00:00Z</date>
</calibration>
"""
CHUNK = """<document version="1.5.0"><chunk><sensors next_id="2"><sensor id="0" label="a" type="frame">
<resolution width="640" height="480"/><bands><band label="Red"/><band label="Green"/></bands>
<calibration type="frame" class="initial"><resolution width="640" height="480"/><f>400</f></calibration>
<calibration type="frame" class="adjusted"><resolution width="640" height="480"/><f>500</f>{}</calibration>
<covariance><params>f cx</params></covariance></sensor>{}</sensors></chunk></document>
"""
OTHER_SENSOR = """<sensor id="1" label="b" type="frame"><calibration type="frame" class="adjusted">
<resolution width="640" height="480"/><f>600</f></calibration></sensor>"""


def depthai(*cameras):
    """A file of DepthAI: type, matrix, coefficients of each socket."""
    pairs = [[n, {"cameraType": kind, "intrinsicMatrix": matrix, "distortionCoeff": lens, "width": 640, "height": 480,
                  "specHfovDeg": 71.86, "lensPosition": 0, "extrinsics": {"toCameraSocket": -1}}]
             for n, (kind, matrix, lens) in enumerate(cameras)]  # fmt: skip
    return json.dumps({"boardName": "OAK-D", "cameraData": pairs, "version": 7})


OAK = [[500, 0, 320], [0, 510, 240], [0, 0, 1]]
TOML = """[cam_0]
name = "A"
size = [ 640, 480,]
matrix = [ [ 500.0, 0.0, 320.0,], [ 0.0, 510.0, 240.0,], [ 0.0, 0.0, 1.0,],]
distortions = {}
rotation = [ 0.0, 0.0, 0.0,]
{}
[metadata]
adjusted = false
error = 0.5
"""
READ = [
    ("slam2.yaml", SLAM, NUMBERS, "radtan", FIVE, (640, 480)),
    ("slam2_stereo.yaml", SLAM + STEREO, NUMBERS, "radtan", FIVE, (640, 480)),
    ("slam3.yaml", SLAM3, (190.9, 190.8, 254.9, 256.8), "fisheye", (0.003, 0.0007, -0.002, 0.0002), (512, 512)),
    ("rectified.yaml", RECTIFIED, NUMBERS, "none", (), (640, 480)),
    ("vslam.yaml", VSLAM.format("perspective", "p1: 0.003\n  p2: 0.004"), NUMBERS, "radtan", KC, (640, 480)),
    ("vslam_fisheye.yaml", VSLAM.format("fisheye", "k3: 0.003\n  k4: 0.004"), NUMBERS, "fisheye", KC, (640, 480)),
    ("flat8.yaml", SLAM + "Camera.k4: 0.06\nCamera.k5: 0.07\nCamera.k6: 0.08\n", NUMBERS, "radtan", EIGHT, (640, 480)),
    ("vins.yaml", VINS_PINHOLE, NUMBERS, "radtan", KC, (640, 480)),
    ("vins_mei.yaml", VINS_MEI, (900, 910, 320, 240), "mei", (1.9, *KC), (640, 480)),
    ("vins_kb.yaml", VINS_KB, (300, 301, 320, 240), "fisheye", (0.01, -0.02, 0.003, 0.004), (640, 480)),
    ("ost.txt", OST, NUMBERS, "radtan", FIVE, (640, 480)),
    ("cal.ini", OST.replace("narrow_stereo", "camera"), NUMBERS, "radtan", FIVE, (640, 480)),
    ("ros1.yaml", INFO.format("rational_polynomial", "D", list(EIGHT), *"KRP"), NUMBERS, "radtan", EIGHT, (640, 480)),
    ("ros2.yaml", INFO.format("equidistant", "d", list(KC), *"krp") * 2, NUMBERS, "fisheye", KC, (640, 480)),
    ("zeros.yaml", INFO.format("rational_polynomial", "D", [0.0] * 8, *"KRP"), NUMBERS, "none", (), (640, 480)),
    ("cv.xml", XML.format("", 5, "0.1 -0.2 0.003 0.004 0.05"), NUMBERS, "radtan", FIVE, (640, 480)),
    ("cv_fisheye.xml", XML.format("<fisheye_model>1</fisheye_model>", 4, "0.1 -0.2 0.003 0.004"), NUMBERS, "fisheye",
     KC, (640, 480)),
    ("cv_fisheye.yml", f"%YAML:1.0\n---\nfisheye_model: 1\ncamera_matrix: {ROWS}\n"
     f"distortion_coefficients: {list(KC)}\n", NUMBERS, "fisheye", KC, (None, None)),
    ("cv_omni.yml", f"%YAML:1.0\n---\nxi: 1.9\ncamera_matrix: {ROWS}\nD: {list(KC)}\n", NUMBERS, "mei", (1.9, *KC),
     (None, None)),
    ("cv_stereo.yml", f"%YAML:1.0\n---\nM1: {ROWS}\nD1: {list(FIVE)}\nM2: {ROWS}\nD2: [1, 1, 1, 1, 1]\n", NUMBERS,
     "radtan", FIVE, (None, None)),
    ("okvis.yaml", OKVIS, NUMBERS, "radtan", KC, (640, 480)),
    ("ncamera.yaml", NCAMERA, NUMBERS, "fisheye", KC, (640, 480)),
    ("svo.yaml", "cam_model: Pinhole\ncam_width: 640\ncam_height: 480\ncam_fx: 500\ncam_fy: 510\ncam_cx: 320\n"
     "cam_cy: 240\ncam_d0: 0.1\ncam_d1: -0.2\ncam_d2: 0.003\ncam_d3: 0.004\n", NUMBERS, "radtan", KC, (640, 480)),
    ("svo_equi.yaml", "cam0:\n  cam_model: PinholeEquidistant\n  cam_width: 640\n  cam_height: 480\n  cam_fx: 500\n"
     "  cam_fy: 510\n  cam_cx: 320\n  cam_cy: 240\n  cam_d0: 0.1\n  cam_d1: -0.2\n  cam_d2: 0.003\n  cam_d3: 0.004\n",
     NUMBERS, "fisheye", KC, (640, 480)),
    ("svo_atan.yaml", "cam_model: PinholeAtan\ncam_width: 640\ncam_height: 480\ncam_fx: 0.5\ncam_fy: 0.625\n"
     "cam_cx: 0.5\ncam_cy: 0.5\ncam_d0: 0.93\n", (320, 300, 319.5, 239.5), "fov", (0.93,), (640, 480)),
    ("ncamera2.yaml", NCAMERA + NCAMERA.split("cameras:\n")[1].replace("cam0", "cam1").replace("500", "600"), NUMBERS,
     "fisheye", KC, (640, 480)),
    ("omni.yaml", "cam0: {camera_model: omni, intrinsics: [1.9, 500, 510, 320, 240], distortion_model: radtan, "
     f"distortion_coeffs: {list(KC)}, resolution: [640, 480]}}", NUMBERS, "mei", (1.9, *KC), (640, 480)),
    ("ds.yaml", "cam0: {camera_model: ds, intrinsics: [-0.2, 0.59, 500, 510, 320, 240], distortion_model: none, "
     "distortion_coeffs: [], resolution: [640, 480]}", NUMBERS, "double_sphere", (-0.2, 0.59), (640, 480)),
    ("eucm.yaml", "cam0: {camera_model: eucm, intrinsics: [0.6, 1.1, 500, 510, 320, 240], distortion_model: none, "
     "distortion_coeffs: []}", NUMBERS, "eucm", (0.6, 1.1), (None, None)),
    ("fov.yaml", "cam0: {camera_model: pinhole, intrinsics: [500, 510, 320, 240], distortion_model: fov, "
     "distortion_coeffs: [0.93]}", NUMBERS, "fov", (0.93,), (None, None)),
    ("ds.json", basalt("ds", xi=-0.2, alpha=0.59), (158, 157, 254, 256), "double_sphere", (-0.2, 0.59), (512, 512)),
    ("kb4.json", basalt("kb4", k1=0.1, k2=-0.2, k3=0.003, k4=0.004), (158, 157, 254, 256), "fisheye", KC, (512, 512)),
    ("ucm.json", basalt("ucm", alpha=0.6), (158, 157, 254, 256), "ucm", (0.6,), (512, 512)),
    ("eucm.json", basalt("eucm", alpha=0.6, beta=1.1), (158, 157, 254, 256), "eucm", (0.6, 1.1), (512, 512)),
    ("radtan8.json", basalt("pinhole-radtan8", k1=0.1, k2=-0.2, p1=0.003, p2=0.004, k3=0.05, k4=0.06, k5=0.07, k6=0.08,
     rpmax=2.7), (158, 157, 254, 256), "radtan", EIGHT, (512, 512)),
    ("transforms.json", transforms(**FULL, k1=0.1, k2=-0.2, p1=0.003, p2=0.004, camera_model="OPENCV"), NUMBERS,
     "radtan", KC, (640, 480)),
    ("fish.json", transforms(**FULL, k1=0.1, k2=-0.2, k3=0.003, k4=0.004, camera_model="OPENCV_FISHEYE"), NUMBERS,
     "fisheye", KC, (640, 480)),
    ("ngp.json", transforms(**FULL, k1=0.1, k2=-0.2, k3=0.003, k4=0.004, is_fisheye=True, camera_angle_x=1.1), NUMBERS,
     "fisheye", KC, (640, 480)),
    ("each.json", transforms([FULL, FULL]), NUMBERS, "none", (), (640, 480)),
    ("blender.json", transforms(camera_angle_x=math.pi / 2, w=640, h=480), (320, 320, 319.5, 239.5), "none", (),
     (640, 480)),
    ("camera_models.json", json.dumps({"v2 a b 640": {"projection_type": "brown", "width": 640, "height": 480,
     "focal_x": 500 / 640, "focal_y": 510 / 640, "c_x": 0.5 / 640, "c_y": 0.5 / 640, "k1": 0.1, "k2": -0.2, "p1": 0.003,
     "p2": 0.004, "k3": 0.05}}), NUMBERS, "radtan", FIVE, (640, 480)),
    ("old.json", json.dumps({"a": {"projection_type": "perspective", "width": 640, "height": 480, "focal": 0.75,
     "k1": 0.1, "k2": 0, "focal_prior": 0.8}}), (480, 480, 319.5, 239.5), "radtan", (0.1, 0, 0, 0), (640, 480)),
    ("opensfm.json", json.dumps({"a": {"projection_type": "perspective", "width": 480, "height": 640, "focal": 0.75,
     "k1": 0.1, "k2": 0}}), (480, 480, 239.5, 319.5), "radtan", (0.1, 0, 0, 0), (480, 640)),
    ("realsense.json", json.dumps({"width": 640, "height": 480, "ppx": 320, "ppy": 240, "fx": 500, "fy": 510,
     "model": "distortion.brown_conrady", "coeffs": [*FIVE]}), NUMBERS, "radtan", FIVE, (640, 480)),
    ("open3d.json", json.dumps({"width": 640, "height": 480, "intrinsic_matrix": [500, 0, 0, 0, 510, 0, 320, 240, 1]}),
     NUMBERS, "none", (), (640, 480)),
    ("replica.json", json.dumps({"camera": {"w": 640, "h": 480, "fx": 500, "fy": 510, "cx": 320, "cy": 240,
     "scale": 6553.5}}), NUMBERS, "none", (), (640, 480)),
    ("nice.yaml", "cam:\n  H: 480\n  W: 640\n  fx: 500\n  fy: 510\n  cx: 320\n  cy: 240\n  png_depth_scale: 5000.\n"
     "  distortion: [0.1, -0.2, 0.003, 0.004, 0.05]\nmapping: {bound: [[-1, 1], [2, 3]]}\n", NUMBERS, "radtan", FIVE,
     (640, 480)),
    ("monogs.yaml", "Dataset:\n  type: tum\n  Calibration:\n    fx: 500\n    fy: 510\n    cx: 320\n    cy: 240\n"
     "    k1: 0.1\n    k2: -0.2\n    p1: 0.003\n    p2: 0.004\n    k3: 0.05\n    width: 640\n    height: 480\n"
     "    depth_scale: 5000.0\n    distorted: True\n", NUMBERS, "radtan", FIVE, (640, 480)),
    ("nested.yaml", f"calibration:\n  camera_matrix: {ROWS}\n  dist: {list(FIVE)}\n  size: [640, 480]\n", NUMBERS,
     "radtan", FIVE, (640, 480)),
    ("parts.yaml", "intrinsics: {fx: 500, fy: 510, cx: 320, cy: 240}\ndistortion: {model: radtan, k1: 0.1, k2: -0.2,"
     " p1: 0.003, p2: 0.004}\nresolution: {width: 640, height: 480}\n", NUMBERS, "radtan", KC, (640, 480)),
    ("around.yaml", f"K: {ROWS}\ncamera: {{model: fisheye}}\nimage_size: 640x480\nfisheye_coeffs: {list(KC)}\n",
     NUMBERS, "fisheye", KC, (640, 480)),
    ("documents.yaml", f"made_by: someone\n---\n{PINHOLE}k1: 0.1\nk2: -0.2\np1: 0.003\np2: 0.004\n...\n", NUMBERS,
     "radtan", KC, (None, None)),
    ("comment.yaml", f"# made by someone\n\n--- # here it comes\n{PINHOLE}", NUMBERS, "none", (), (None, None)),
    ("ros_params.yaml", f"/**:\n  ros__parameters:\n    camera:\n      K: {MATRIX}\n      D: {list(KC)}\n", NUMBERS,
     "radtan", KC, (None, None)),
    ("wide_matrix.yaml", "K: [[500, 0, 320, 0], [0, 510, 240, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n", NUMBERS, "none", (),
     (None, None)),
    ("matrix.txt", "500 0 320 0\n0 510 240 0\n0 0 1 0\n0 0 0 1\n", NUMBERS, "none", (), (None, None)),
    ("row.txt", "500 0 320 0 510 240 0 0 1\n", NUMBERS, "none", (), (None, None)),
    ("rational.txt", "500 510 320 240 .1 -.2 .003 .004 .05 .06 .07 .08\n", NUMBERS, "radtan", EIGHT, (None, None)),
    ("projection.txt", "500 0 320 0\n0 510 240 0\n0 0 1 0\n", NUMBERS, "none", (), (None, None)),
    ("dso.txt", "RadTan 500 510 320 240 .1 -.2 .003 .004\n640 480\ncrop\n640 480\n", NUMBERS, "radtan", KC, (640, 480)),
    ("dso_kb.txt", "KannalaBrandt 500 510 320 240 .1 -.2 .003 .004\n640 480\nfull\n640 480\n", NUMBERS, "fisheye", KC,
     (640, 480)),
    ("dso_equi.txt", "EquiDistant 500 510 320 240 .1 -.2 .003 .004\n640 480\n0.4 0.5 0.5 0.5 0\n640 480\n", NUMBERS,
     "fisheye", KC, (640, 480)),
    ("dso_fov.txt", "FOV 0.5 0.625 0.5 0.5 0.93\n640 480\ncrop\n640 480\n", (320, 300, 319.5, 239.5), "fov", (0.93,),
     (640, 480)),
    ("dso_five.txt", "500 510 320 240 0.93\n640 480\ncrop\n640 480\n", NUMBERS, "fov", (0.93,), (640, 480)),
    ("dso_none.txt", "Pinhole 500 510 320 240 0\n640 480\nnone\n640 480\n", NUMBERS, "none", (), (640, 480)),
    ("mast3r.yaml", f"width: 640\nheight: 480\ncalibration: {[500, 510, 320, 240, *FIVE]}\n",
     NUMBERS, "radtan", FIVE, (640, 480)),
    ("mast3r4.yaml", "width: 640\nheight: 480\ncalibration: [500, 510, 320, 240]\n", NUMBERS, "none", (), (640, 480)),
    ("maplab.yaml", "cameras:\n- camera:\n    image_width: 640\n    image_height: 480\n    type: unified-projection\n"
     "    intrinsics: {rows: 5, cols: 1, data: [1.5, 500, 510, 320, 240]}\n    distortion:\n"
     f"      type: radial-tangential\n      parameters: {{rows: 4, cols: 1, data: {list(KC)}}}\n",
     NUMBERS, "mei", (1.5, *KC), (640, 480)),
    ("polycam.json", json.dumps({"fx": 500, "fy": 510, "cx": 320, "cy": 240, "width": 640, "height": 480,
     **{f"t_{k}{n}": 0.1 * n for k in range(3) for n in range(4)}}), NUMBERS, "none", (), (640, 480)),
    ("attributes.xml", '<camera model="fisheye" width="640" height="480"><fx>500</fx><fy>510</fy>'
     "<cx>320</cx><cy>240</cy><d>.1 -.2 .003 .004</d></camera>", NUMBERS, "fisheye", KC, (640, 480)),
    ("profile.json", json.dumps(GYROFLOW), NUMBERS, "fisheye", KC, (640, 480)),
    ("middlebury.txt", MIDDLEBURY.format(320, 0), NUMBERS, "none", (), (640, 480)),
    ("realsense.txt", REALSENSE.format("Inverse Brown Conrady", "0 0 0 0 0"), NUMBERS, "none", (), (640, 480)),
    ("realsense_lens.txt", REALSENSE.format("Brown Conrady", "0.1 \t-0.2 \t0.003 \t0.004 \t0.05"), NUMBERS, "radtan",
     FIVE, (640, 480)),
    ("realsense_wide.txt", REALSENSE.format("Kannala Brandt4", "0.1 -0.2 0.003 0.004 0"), NUMBERS, "fisheye", KC,
     (640, 480)),
    ("realsense_line.txt", SHOWN.format("Brown Conrady"), NUMBERS, "radtan", FIVE, (640, 480)),
    ("Calib_Results.m", BOUGUET.format("0.000000000000000"), NUMBERS, "radtan", FIVE, (640, 480)),
    ("Calib_Results.txt", BOUGUET.format("0"), NUMBERS, "radtan", FIVE, (640, 480)),
    ("Calib_Results_stereo.m", STEREO_BOUGUET, NUMBERS, "radtan", FIVE, (None, None)),
    ("own.m", "K = [500 0 320; 0 510 240; 0 0 1];\ndist = [0.1, -0.2, 0.003, 0.004, 0.05]; % k1 k2 p1 p2 k3\n", NUMBERS,
     "radtan", FIVE, (None, None)),
    ("matlab.json", json.dumps(MATLAB), NUMBERS, "radtan", FIVE, (640, 480)),
    ("matlab_k.json", json.dumps({"params": {**MATLAB, "K": [[500, 0, 321], [0, 510, 241], [0, 0, 1]],
     "IntrinsicMatrix": None}}), NUMBERS, "radtan", FIVE, (640, 480)),
    ("matlab_stereo.json", json.dumps({"CameraParameters1": MATLAB, "CameraParameters2": {**MATLAB,
     "RadialDistortion": [0, 0]}}), NUMBERS, "radtan", FIVE, (640, 480)),
    ("matlab.txt", DISPLAYED, NUMBERS, "radtan", (0.1, -0.2, 0, 0, 0), (640, 480)),
    ("entries.yaml", f"- K: {ROWS}\n- D: [{list(FIVE)}]\n- R: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n- t: [[1], [2]]\n",
     NUMBERS, "radtan", FIVE, (None, None)),
    ("twice.yaml", PINHOLE + f"distortion: {{k1: 0.1, k2: -0.2, p1: 0.003, p2: 0.004, k3: 0.05}}\nD: {list(FIVE)}\n",
     NUMBERS, "radtan", FIVE, (None, None)),
    ("photonvision.json", json.dumps({"resolution": {"width": 640, "height": 480}, "cameraIntrinsics": {"rows": 3,
     "cols": 3, "type": 6, "data": json.loads(MATRIX)}, "distCoeffs": {"rows": 1, "cols": 8, "type": 6, "data": EIGHT},
     "observations": []}), NUMBERS, "radtan", EIGHT, (640, 480)),
    ("radial.yaml", PINHOLE + f"model: fisheye\nradial_distortion: {list(KC)}\n", NUMBERS, "fisheye", KC, (None, None)),
    ("apart.yaml", PINHOLE + "radial_distortion: [0.1, -0.2, 0.05]\ntangential_distortion: [0.003, 0.004]\n", NUMBERS,
     "radtan", FIVE, (None, None)),
    ("apart.json", json.dumps({"fx": 500, "fy": 510, "cx": 320, "cy": 240, "distortion": {"radial": [0.1, -0.2],
     "tangential": [0.003, 0.004]}}), NUMBERS, "radtan", (*KC, 0), (None, None)),
    ("cameras.sfm", meshroom("1.0.0", "radial3", FIVE[:3]), SQUARE, "radtan", (0.1, -0.2, 0, 0, 0.003), (640, 480)),
    ("sfm.json", meshroom("1.2.1", "brown", [0.1, -0.2, 0.05, 0.003, 0.004],
     {"pxFocalLength": ["500", "510"], "principalPoint": ["0", "0"]}), NUMBERS, "radtan", FIVE, (640, 480)),
    ("pixel_ratio.sfm", meshroom("1.2.4", "pinhole", [], {**LATER, "pixelRatio": str(1 / 1.02)}), NUMBERS, "none", (),
     (640, 480)),
    ("later.sfm", meshroom("1.2.6", "radial1", [0.1], LATER), NUMBERS, "radtan", (0.1, 0, 0, 0), (640, 480)),
    ("latest.sfm", meshroom("1.2.12", "pinhole", KC, LATER | {"distortionType": "fisheye4"}), NUMBERS, "fisheye", KC,
     (640, 480)),
    ("sfm_data.json", openmvg(("pinhole_radial_k3", MVG | {"disto_k3": [0.1, -0.2, 0.05]})), SQUARE, "radtan",
     (0.1, -0.2, 0, 0, 0.05), (640, 480)),
    ("two_terms.json", openmvg(("pinhole_radial_k3", MVG | {"disto_k3": [0.1, -0.2]})), SQUARE, "radtan",
     (0.1, -0.2, 0, 0, 0), (640, 480)),
    ("brown.json", openmvg(*[("pinhole_brown_t2", {"value0": MVG, "disto_t2": [0.1, -0.2, 0.05, 0.003, 0.004]})] * 2),
     SQUARE, "radtan", FIVE, (640, 480)),
    ("fisheye.json", openmvg(("fisheye", MVG | {"fisheye": KC})), SQUARE, "fisheye", KC, (640, 480)),
    ("pinhole.json", openmvg(("pinhole", MVG)), SQUARE, "none", (), (640, 480)),
    ("cam.cameramodel", MRCAL.format("OPENCV8", str(EIGHT)[1:]).replace(")", ""), NUMBERS, "radtan", EIGHT, (640, 480)),
    ("pinhole.cameramodel", MRCAL.format("PINHOLE", "").replace("lensmodel", "lens_model"), NUMBERS, "none", (),
     (640, 480)),
    ("SN1.conf", ZED.format("k1=0.1\nk2=-0.2\np1=0.003\np2=0.004\nk3=0.05"), ZED_NUMBERS, "radtan", FIVE, (1280, 720)),
    ("SN2.conf", ZED.format("") + "[LEFT_DISTO]\nk1=.1\nk2=-.2\np1=.003\np2=.004\nk3=.05\nk4=.06\nk5=.07\nk6=.08\n",
     ZED_NUMBERS, "radtan", EIGHT, (1280, 720)),
    ("metashape.xml", METASHAPE.format("frame", "<k3>0.05</k3><p1>0.004</p1><p2>0.003</p2>"), NUMBERS, "radtan", FIVE,
     (640, 480)),
    ("metashape_fisheye.xml", METASHAPE.format("fisheye", "<k3>0.003</k3><k4>0.004</k4>"), NUMBERS, "fisheye", KC,
     (640, 480)),
    ("doc.xml", CHUNK.format("<cx>0.5</cx><cy>0.5</cy><b1>0</b1><k1>.1</k1><k2>-.2</k2>", ""), (500, 500, 320, 240),
     "radtan", (0.1, -0.2, 0, 0, 0), (640, 480)),
    ("oak.json", depthai((0, [[0.0] * 3] * 3, []), (0, OAK, [*EIGHT, *[0.0] * 6])), NUMBERS, "radtan", EIGHT,
     (640, 480)),
    ("oak_w.json", depthai((1, OAK, [*KC, *[0.0] * 10])), NUMBERS, "fisheye", KC, (640, 480)),
    ("record3d.json", json.dumps({"w": 640, "h": 480, "fps": 60, "K": [500, 0, 0, 0, 510, 0, 320, 240, 1],
     "cameraType": 1, "perFrameIntrinsicCoeffs": [[500, 510, 320, 240]] * 3, }), NUMBERS, "none", (), (640, 480)),
    ("nerfies.json", json.dumps({"focal_length": 500.0, "principal_point": [320.0, 240.0], "skew": 0.0,
     "pixel_aspect_ratio": 1.02, "radial_distortion": [0.1, -0.2, 0.05], "tangential_distortion": [0.003, 0.004],
     "image_size": [640, 480]}), NUMBERS, "radtan", FIVE, (640, 480)),
    ("anipose.toml", TOML.format("[0.1, -0.2, 0.003, 0.004, 0.05,]", ""), NUMBERS, "radtan", FIVE, (640, 480)),
    ("anipose_wide.toml", TOML.format("[0.1, -0.2, 0.003, 0.004]", "fisheye = true"), NUMBERS, "fisheye", KC,
     (640, 480)),
    ("a.pincam", "640 480 500 510 320 240\n", NUMBERS, "none", (), (640, 480)),
    ("okvis2.yaml", OKVIS.replace("T_SC:", "camera_type: gray, T_SC:"), NUMBERS, "radtan", KC, (640, 480)),
    ("camodocal.yaml", VINS_PINHOLE.replace("PINHOLE", "PINHOLE_FULL").replace(
     "   p1", "   k3: 0.05\n   k4: 0.06\n   k5: 0.07\n   k6: 0.08\n   p1"), NUMBERS, "radtan", EIGHT, (640, 480)),
    ("slam_tlr.yaml", SLAM + "Tlr: !!opencv-matrix\n  rows: 3\n  cols: 4\n  dt: f\n  data: [1, 0, 0, 0.1, 0, 1, 0, 0, "
     "0, 0, 1, 0]\nvelo_to_cam: [1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, 0]\n", NUMBERS, "radtan", FIVE, (640, 480)),
    ("cv5.yml", f"%YAML 1.2\n---\nK: {ROWS}\nD: !!opencv-nd-matrix\n   sizes: [ 5 ]\n   dt: d\n   data: {list(FIVE)}\n",
     NUMBERS, "radtan", FIVE, (None, None)),
    ("cv_comment.json", f'{{\n  "K": {ROWS}\n  // flags: +zero_tangent_dist\n  ,\n  "D": {list(FIVE)}\n}}', NUMBERS,
     "radtan", FIVE, (None, None)),
    ("tuple.yaml", f"K: {ROWS}\ndist: !!python/tuple {list(FIVE)}\nimage_size: !!python/tuple\n- 640\n- 480\n", NUMBERS,
     "radtan", FIVE, (640, 480)),
    ("led.yml", f"left_camera_matrix: {ROWS}\nleft_dist_coeffs: {list(FIVE)}\nright_camera_matrix: {MATRIX}\n"
     f"right_dist_coeffs: {list(KC)}\n", NUMBERS, "radtan", FIVE, (None, None)),
    ("led.json", json.dumps({"cam0_K": json.loads(ROWS), "cam0_D": FIVE, "cam1_K": np.eye(3).tolist(), "cam1_D": KC}),
     NUMBERS, "radtan", FIVE, (None, None)),
    ("azure.yaml", f"depth_camera: {{K: {MATRIX.replace('500', '400')}}}\ncolor_camera: {{K: {MATRIX}}}\n", NUMBERS,
     "none", (), (None, None)),
    ("camera.ini", "; made by someone\n[camera]\nfx = 500\nfy = 510 ; pixels\ncx = 320\ncy = 240\nk1 = 0.1\nk2 = -0.2\n"
     "p1 = 0.003\np2 = 0.004\n[other]\nname\n", NUMBERS, "radtan", KC, (None, None)),
    ("camera.cfg", f"[intrinsics]\ncamera_matrix = {ROWS}\n[distortion]\ncoefficients = 0.1 -0.2 0.003 0.004 0.05\n"
     "[image]\nwidth = 640\nheight = 480\n", NUMBERS, "radtan", FIVE, (640, 480)),
    ("calib_cam_to_cam.txt", KITTI_RAW, (721.5377, 721.5377, 609.5593, 172.854), "none", (), (1242, 375)),
    ("kitti_recorded.txt", KITTI_RAW.replace("_rect", "_left"), (984.2439, 980.8141, 690, 233.1966), "radtan",
     (-0.3728755, 0.2037299, 0.002219027, 0.001383707, -0.07233722), (1392, 512)),
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "text", "numbers", "model", "coefficients", "size"), READ, ids=[row[0] for row in READ]
)
def test_what_is_read(make, name, text, numbers, model, coefficients, size):
    found = read_calibration(make.text(name, text))
    assert (found.fx, found.fy, found.cx, found.cy) == pytest.approx(numbers)
    assert (found.model, found.coefficients) == (model, pytest.approx(coefficients))
    assert (found.width, found.height) == size
    assert found.dialect


@pytest.mark.parametrize("text", ["'0.1 -0.2 0.003 0.004'", '"[0.1, -0.2, 3e-3, 4.e-3]"', "(.1, -.2, .003, .004)"])
def test_coefficients_written_as_a_text(make, text):
    found = read_calibration(make.text("c.yaml", f"{PINHOLE}distortion_coefficients: {text}\n"))
    assert (found.model, found.coefficients) == ("radtan", KC)


NAMES = [
    "dist_coeffs", "dist_coeff", "dist", "d", "D", "distortion", "Distortion_Coefficients", "coeffs", "distCoeffs",
    "distortion_parameters", "distortion coefficients", "kc", "distortion_coefs", "lens_distortion", "dist_params",
]  # fmt: skip


@pytest.mark.parametrize("key", NAMES)
def test_names_of_coefficients(make, key):
    found = read_calibration(make.text("c.yaml", f"camera_matrix: {ROWS}\n{key}: {list(FIVE)}\n"))
    assert (found.model, found.coefficients) == ("radtan", FIVE)


@pytest.mark.parametrize(
    "size",
    [
        "image_width: 640\nimage_height: 480", "cols: 640\nrows: 480", "w: 640\nh: 480", "W: 640\nH: 480",
        "resolution: [640, 480]", "size: [640, 480]", "image_size: [640, 480]", "imageSize: {width: 640, height: 480}",
        "img_w: 640\nimg_h: 480", "width: 0640\nheight: 0480", "size: [0640,0480]",
        "resolution_width: 640\nresolution_height: 480", "DIM: [640, 480]",
        "img_width: 640\nimg_height: 480", "Camera.width: 640\nCamera.height: 480", "resolution: 640x480",
    ],
)  # fmt: skip
def test_names_of_sizes(make, size):
    found = read_calibration(make.text("c.yaml", f"{PINHOLE}{size}\n"))
    assert (found.width, found.height) == (640, 480)


LENS_KEYS = [
    "lens_warp: [-0.28, 0.07, 0.0002, 0.0, 0.0]", "barrel: -0.28", "optical_aberration: [0.1, 0.2]", "k9: 0.1",
    "fisheye_parameters: [0.1, 0.2, 0.3]", "mystery: [-0.28, 0.07, 0.0002, 0.0, 0.0]", "xi: 1.2", "skew: 0.5",
    "radial: [0.1, 0.2]", "Glass: {k1: 0.1}", "k1: [0.1, 0.2]", "tangential_distortion: [0.1, 0.2]", "tau_x: 0.1",
    "distorted: true",
    "poly_parameters: {p0: 1.0, p1: 2.0}", "Camera.kappa: 0.3", "inner: {distortion_coefficients: [0.1, 0, 0, 0]}",
    "undocumented: {fisheye: true, k1: 0.2}", "curvature: -0.1",
    "mapping: equisolid", "optics_kind: stereographic", "wide_angle: true", "distortion_coefficients: some",
    "resolution: {width: 640, height: 480, distort: {type: DISTORT_FTHETA, coeffs: [0.1, -0.2, 0.02, 0.001]}}",
    "cam_d0: [0.1]\nmodel: none", "camera_k7: 0.1", "disto_k3: [-0.2, 0.05, 0.01]", "k: [0.1, -0.2]",
    "p: [0.003, 0.004]",
]  # fmt: skip


@pytest.mark.parametrize("line", LENS_KEYS)
def test_a_lens_that_is_not_understood_is_refused_by_name(make, line):
    known = line.split(":")[0].split(".")[-1]
    body = PINHOLE + "model: radtan\ncoefficients: [0.1, 0, 0, 0]\n" if line.startswith("xi") else PINHOLE
    file = make.text("c.yaml", f"{body}{line}\n")
    with pytest.raises(DvoError, match=known) as caught:
        read_calibration(file)
    assert caught.value.file == file and caught.value.field and caught.value.remedy


@pytest.mark.parametrize(
    "line",
    [
        "distortion: []", "skew: 0", "distortion_model: none", "fisheye: 0", "undistort: true", "min_dist: 30",
        "rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}", "T_cam_imu: [1, 2, 3, 4]",
        "camera_name: lens 4", "per_view_errors: [0.1, 0.2, 0.3, 0.4]", "distortion_model: ''", "k1: 0.0",
        "roi: [1, 2, 3, 4]",
        "t_00: 0.98\nt_13: -0.4", "extrinsic: {q_bc: [0, 0, 0, 1]}", "polymorphic_id: 7", "r_22: 1",
        "model: inverse_brown_conrady\ncoeffs: [0, 0, 0, 0, 0]", "model: distortion.modified_brown_conrady\nd: [0]",
        "quaternion: [0, 0, 0, 1]", "distance: 4", "serial: abc", "P1: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]",
    ],
)  # fmt: skip
def test_entries_of_other_matters_are_ignored(make, line):
    found = read_calibration(make.text("c.yaml", f"{PINHOLE}{line}\n"))
    assert found.model == "none" and found.fx == 500


REFUSED = [
    ("cam.cameramodel", MRCAL.format("CAHVOR", " .1, .2, .3, .4, .5"), "LENSMODEL_CAHVOR is not known"),
    ("cam.cameramodel", MRCAL.format("OPENCV5", " .1, .2, .3, .4"), "LENSMODEL_OPENCV5 has 9 numbers"),
    ("cam.cameramodel", MRCAL.format("OPENCV5", "")[:-3], "no dictionary of Python"),
    ("SN.conf", ZED.format("") + ZED.format("").replace("_HD", "_VGA"), "4 cameras in it: 0: LEFT_CAM_HD"),
    ("SN.conf", "[LEFT_CAM_CAM_HD]\nfx=1\n", "no fx, fy, cx, cy in it"),
    ("SN.conf", ZED.format("k1=.1\nk1=.2"), "k1: twice"),
    ("SN.conf", ZED.format("k1=0,1"), "k1: no number: '0,1'"),
    ("SN.conf", ZED.format("") + "[LEFT_DISTO]\nk1=0.1\np1=?\n", "p1: no number"),
    ("SN.conf", ZED.format("") + "[LEFT_DISTO]\nk1=1\nk2=2\nk3=3\nk4=4\n", "may be that of a fisheye"),
    ("SN.conf", ZED.format("").replace("fx=700", ""), "no fx, fy, cx, cy in it"),
    ("a.xml", METASHAPE.format("frame", "<k4>0.1</k4>"), "a camera of type frame of dvo has no k4"),
    ("a.xml", METASHAPE.format("fisheye", "<p1>0.1</p1>"), "has no p1"),
    ("a.xml", METASHAPE.format("frame", "<b2>3</b2>"), "skew"),
    ("a.xml", METASHAPE.format("spherical", ""), "cameras of type 'spherical' are not known"),
    ("a.xml", METASHAPE.format("frame", "").replace("640", ""), "no size of the images"),
    ("a.xml", CHUNK.format("", OTHER_SENSOR), "2 cameras in it: 0: a, 1: b"),
    ("oak.json", depthai((0, OAK, []), (0, OAK, [*KC])), "2 cameras in it: 0: socket 0 640x480"),
    ("oak.json", depthai(([], OAK, [*KC])), "cameras of type \\[\\] are not known"),
    ("oak.json", depthai((2, OAK, [*KC])), "cameras of type 2 are not known"),
    ("oak.json", depthai((0, OAK, [*EIGHT, 0, 0, 0, 0, 0.1, 0.2])), "14 coefficients"),
    ("oak.json", depthai(), "no camera in it"),
    ("coded.json", json.dumps({"fx": 500, "fy": 510, "cx": 320, "cy": 240, "cameraType": 1, "d": KC}),
     "cameraType: unknown distortion model '1'"),
    ("a.pincam", "nan 480 500 510 320 240\n", "resolution: expected width and height"),
    ("six.txt", "640 480 500 510 320 240\n", "6 numbers"),
    ("c.yaml", VSLAM.format("equirectangular", ""), "unknown distortion model 'equirectangular'"),
    ("c.yaml", VSLAM.format("radial_division", ""), "unknown distortion model"),
    ("c.yaml", VSLAM.format("fisheye", "p1: 0.1"), "Camera.p1"),
    ("c.yaml", VINS.format("SCARAMUZZA", "fx: 1\nfy: 1\ncx: 1\ncy: 1"), "unknown distortion model 'SCARAMUZZA'"),
    ("c.yaml", "K: [[500, 2, 320], [0, 510, 240], [0, 0, 1]]\n", "skew"),
    ("c.txt", "500 2 320\n0 510 240\n0 0 1\n", "skew"),
    ("c.yaml", RECTIFIED + "Camera1.k1: 0.1\n", "Camera1.k1"),
    ("c.yaml", f"{PINHOLE}model: fisheye\ndistortion_model: plumb_bob\n", "two lens models"),
    ("c.yaml", f"{PINHOLE}D: {[0.1] * 14}\n", "14 coefficients"),
    ("c.yaml", f"{PINHOLE}model: ucm\nalpha: 1.5\n", "alpha=1.5"),
    ("c.yaml", f"{PINHOLE}model: eucm\nalpha: 0.5\n", "1 coefficients"),
    ("c.yaml", f"left: {{{PINHOLE.replace(chr(10), ', ')}}}\nfront: {{fx: 1, fy: 1, cx: 1, cy: 1}}\n"
     "left_2: 3\n".replace("left:", "back:"), "2 cameras in it: "),
    ("c.yaml", f"{PINHOLE}---\n{PINHOLE.replace('500', '400')}", "a list of 2 cameras that differ"),
    ("c.yaml", "fx: 500\nfy: 510\n", "no cx, cy in it"),
    ("c.yaml", "camera: {exposure: 3}\nname: x\n", "no fx, fy, cx, cy in it, nor a camera matrix: camera, name"),
    ("c.json", "{", "not valid JSON"),
    ("c.json", '{"fx": 1, "fx": 2}', "a key twice"),
    ("c.json", "[" * 100_000, "not valid JSON"),
    ("c.xml", "<?xml version='1.0'?><a><b></a>", "not valid XML"),
    ("c.xml", "<?xml version='1.0'?><!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>", "XML with declarations"),
    ("ost.txt", OST.replace("distortion", "lens warp"), "lens warp"),
    ("ost.txt", OST.replace("0.1 -0.2", "0.1 minus"), "not understood"),
    ("t.json", transforms(**FULL, k1=0.1, k4=0.1, camera_model="OPENCV"), "k4"),
    ("o.json", json.dumps({"a": {"projection_type": "spherical", "width": 640, "height": 480}}), "projection_type"),
    ("o.json", json.dumps({"a": {"projection_type": "perspective", "width": 640, "height": 480, "focal": 1, "p1": 1}}),
     "p1"),
    ("o.json", json.dumps({"a": {"projection_type": "brown", "width": 640, "height": 480, "focal_x": 1, "b1": 1}}),
     "b1"),
    ("shares.json", json.dumps({"fx": 0.8, "fy": 1.1, "cx": 0.5, "cy": 0.5, "width": 640, "height": 480}),
     "a share of"),
    ("o.json", '{"projection_type": "perspective", "width": NaN, "height": 480, "focal": 1}', "width"),
    ("o.json", '{"projection_type": "perspective", "width": 1e999, "height": 480, "focal": 1}', "width"),
    ("o.json", '{"projection_type": "perspective", "width": 64.5, "height": 480, "focal": 1}', "width"),
    ("width.txt", "width 640\nfx 500\nfy 500\ncx 320\ncy 240\n", "not a number in 'width 640'"),
    ("skew.csv", "skew,0.5\nfx,500\nfy,500\ncx,320\ncy,240\n", "not a number in 'skew,0.5'"),
    ("pairs.txt", "525,525 319,239 0,0 0,0", "commas between numbers, or within them"),
    ("shares.txt", "0.8 1.1 0.5 0.5", "a share of"),
    ("o.json", json.dumps({k: {"projection_type": "perspective", "width": 640, "height": 480, "focal": f} for k, f in
     (("a", 0.8), ("b", 0.9))}), "2 cameras in it"),
    ("t.json", transforms(camera_angle_x=1.0), "angle of view without the size"),
    ("t.json", transforms([FULL, {**FULL, "fl_x": 400}]), "frames of different cameras"),
    ("t.json", transforms(**FULL, camera_model="EQUIRECTANGULAR"), "unknown distortion model"),
    ("dso.txt", "Pinhole 500 510 320 240 0.5\n640 480\ncrop\n640 480\n", "a distortion of 0.5"),
    ("dso.txt", "RadTan 500 510 320 240 0.5\n640 480\ncrop\n640 480\n", "5 numbers of the model RadTan"),
    ("calib_cam_to_cam.txt", KITTI_RAW.replace("P_rect_00: 7", "P_rect_00: x"), "not a number"),
    ("realsense.json", json.dumps({"fx": 500, "fy": 510, "ppx": 320, "ppy": 240, "model": "inverse_brown_conrady",
     "coeffs": [0.1] * 5}), "inverse_brown_conrady"),
    ("centre.yaml", "fx: 500\nfy: 510\ncx: 0.5\ncy: 0.5\nwidth: 640\nheight: 480\n", "or a share of the size"),
    ("centre.txt", "500 510 0.5 0.5", "a share of the size"),
    ("middlebury.txt", MIDDLEBURY.format(320, 0).replace("193.001", "wide"), "baseline: no numbers: 'wide'"),
    ("middlebury.txt", MIDDLEBURY.format(320, 0).replace("cam0", "cam1", 1), "cam1: twice in it"),
    ("middlebury.txt", MIDDLEBURY.format(320, 0).replace("[500 0", "[500 1"), "skew"),
    ("realsense.txt", REALSENSE.format("Inverse Brown Conrady", "0.1 0 0 0 0"), "Inverse Brown Conrady"),
    ("realsense.txt", REALSENSE.format("Brown Conrady", "none"), "coefficients: no number: 'none'"),
    ("realsense.txt", REALSENSE.format("", "").split("  Fx")[0], 'Intrinsic of "Depth": no fx, fy, model, coeffi'),
    ("realsense.txt", REALSENSE.format("Brown Conrady", "0 0 0 0 0") * 2, "4 cameras in it: 0: Depth 640x480, 1: Col"),
    ("realsense.txt", SHOWN.format("F-Theta"), "F-Theta"),
    ("Calib_Results.m", BOUGUET.format("0.01"), "skew"),
    ("own.m", "x = 3;\n", "no fx, fy, cx, cy in it, nor a camera matrix: x"),
    ("matlab.json", json.dumps({**MATLAB, "IntrinsicMatrix": [[500, 0, 0], [3, 510, 0], [320, 240, 1]]}), "skew"),
    ("matlab.json", json.dumps({**MATLAB, "PrincipalPoint": 3, "IntrinsicMatrix": None, "FocalLength": [500, 510]}),
     "PrincipalPoint: no two numbers"),
    ("cameras.sfm", meshroom("1.2.6", "3declassicld", KC, LATER), "type: '3declassicld' is not read"),
    ("cameras.sfm", meshroom("1.2.6", "equidistant", [], LATER | {"distortionType": "radialk3"}), "'equidistant'"),
    ("cameras.sfm", meshroom("1.2.6", "radial1", KC, LATER), "distortionParams: 4 coefficients of radial1"),
    ("cameras.sfm", meshroom("1.0", "pinhole", []), "version: no version of three numbers"),
    ("cameras.sfm", meshroom("1e999.0.0", "pinhole", []), "version: no number: '1e999'"),
    ("cameras.sfm", meshroom("1.nan.0", "pinhole", []), "version: no number: 'nan'"),
    ("cameras.sfm", meshroom("1.0.0", "pinhole", [], {"pxFocalLength": "x"}), "pxFocalLength: no number: 'x'"),
    ("cameras.sfm", meshroom("1.2.6", "pinhole", [], LATER | {"sensorWidth": "0"}), "sensorWidth, pixelRatio"),
    ("cameras.sfm", meshroom("1.0.0", "pinhole", [], intrinsics={}), "intrinsics: no list of cameras"),
    ("sfm_data.json", openmvg(("spherical", {"width": 640, "height": 320})), "'spherical' is not read"),
    ("sfm_data.json", openmvg(("pinhole", MVG | {"disto_k1": [0.1]})), "disto_k1: not of the type pinhole"),
    ("sfm_data.json", openmvg(("pinhole", MVG), ("pinhole", MVG | {"focal_length": 400})), "2 cameras in it: 0: 0,"),
    ("sfm_data.json", openmvg(), "no camera in it"),
    ("sfm_data.json", openmvg(("pinhole_brown_t2", MVG | {"disto_t2": "x"})), "disto_t2: expected 5 numbers"),
    ("meshroom.json", json.dumps({"intrinsics": [{"width": "640", "height": "480", "sensorWidth": "36",
     "type": "pinhole", "focalLength": "29.5", "principalPoint": ["320", "240"], "distortionParams": ""}]}),
     "sensorWidth.*millimetres"),
    ("blender.json", '{"focal_length": 50, "sensor_width": 36, "cx": 159.5, "cy": 119.5, "width": 320, "height": 240}',
     "sensor_width.*millimetres"),
    ("unit.yaml", "fx: 25\nfy: 25\ncx: 18\ncy: 12\nunits: mm\n", "units: 'mm'"),
    ("distorted.yaml", PINHOLE + "k1: 0.1\nk2: 0.2\np1: 0\np2: 0\ndistorted: False\n", "distorted: false, but"),
    ("a2d2.json", json.dumps({"CamMatrix": [[400, 0, 320], [0, 410, 240], [0, 0, 1]], "CamMatrixOriginal":
     [[500, 0, 320], [0, 510, 240], [0, 0, 1]], "Distortion": [KC], "Lens": "Fisheye", "Resolution": [640, 480]}),
     "CamMatrixOriginal: is another matrix of a camera with a lens"),
    ("twice.yaml", PINHOLE + f"distortion: {{k1: 0.1, k2: -0.3}}\nD: {list(FIVE)}\n", "distortion.k2"),
    ("radial.yaml", PINHOLE + f"radial_distortion: {list(KC)}\n", "radial_distortion may be lens distortion"),
    ("new.yaml", f"new_camera_matrix: {ROWS}\ndist: {list(FIVE)}\n", "that of undistorted images"),
    ("stated.yaml", "fx: 50\nfy: 50\ncx: 320\ncy: 240\nwidth: 640\nheight: 480\n", "fx=50 does not fit"),
    ("profile.json", json.dumps(GYROFLOW | {"digital_lens": "gopro_superview"}), "digital_lens: 'gopro_superview'"),
    ("profile.json", json.dumps(GYROFLOW | {"distortion_model": "poly5"}), "distortion_model: 'poly5'"),
    ("profile.json", json.dumps(GYROFLOW | {"fisheye_params": 3}), "not a mapping"),
    ("aspect.yaml", "focal_length: 500\naspect_ratio: 1.02\ncx: 320\ncy: 240\n", "aspect_ratio: 1.02 beside one"),
    ("xi.yaml", VINS_PINHOLE + "xi: 1.9\n", "xi may be lens distortion"),
    ("four.yaml", PINHOLE + "k1: 0.1\nk2: -0.2\nk3: 0.003\nk4: 0.004\n", "k4: k1 to k4 without p1 and p2"),
    ("undistorted.yaml", PINHOLE + f"D: {list(FIVE)}\nundistorted: true\n", "undistorted: true, but there are coeffic"),
    ("rectified.yaml", PINHOLE + f"D: {list(FIVE)}\nrectified: 1\n", "rectified: 1, but there are coefficients"),
    ("zeros.yaml", f"K: {[0.0] * 9}\nD: []\n", "the camera is not calibrated"),
    ("camera.ini", "[camera]\nfx = 500\nfx = 510\n", "not understood .*fx"),
    ("warp.ini", "[camera]\nfx = 500\nfy = 510\ncx = 320\ncy = 240\nlens_warp = 0.1 0.2\n", "camera.lens_warp"),
    ("cut.toml", "[cam_0]\nmatrix = [ [ 500.0,", "not valid TOML"),
    ("own.toml", TOML.format("[0.1, -0.2]", "warp = [0.1, 0.2, 0.3, 0.4, 0.5]"), "2 coefficients"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "text", "match"), REFUSED, ids=[f"{n}-{row[0]}" for n, row in enumerate(REFUSED)])
def test_what_is_refused(make, name, text, match):
    file = make.text(name, text)
    with pytest.raises(DvoError, match=match) as caught:
        read_calibration(file)
    assert caught.value.file == file and caught.value.remedy


@pytest.mark.parametrize(("values", "remedy"), [
    ({"CameraDefaults": {"CaptureSettings": [{"Width": 640, "Height": 480, "FOV_Degrees": 90}]}}, "tan("),
    ({"fieldOfView": 60.0, "pixelWidth": 640}, "vertical angle"), ({"fov": 90}, "horizontal angle"),
    ({"lens": 50.0, "sensor_width": 36.0, "resolution_x": 640}, "width of the sensor"), ({"a": 1}, "write 'fx fy cx"),
])  # fmt: skip
def test_files_of_simulators_and_renderers_are_refused_with_the_formula(make, values, remedy):
    with pytest.raises(DvoError, match="no fx, fy, cx, cy in it") as caught:
        read_calibration(make.text("settings.json", json.dumps(values)))
    assert remedy in str(caught.value.remedy)


@pytest.mark.parametrize("text", [
    "fx,fy,cx,cy,k1,k2\n500,510,320,240,0.1,-0.2\n", "fx fy cx cy k1 k2\n500 510 320 240 0.1 -0.2\n",
    "parameter;value\nFX;500\nFY;510\nCX;320\nCY;240\nk1;0.1\nk2;-0.2\n",
    "fx 500\nfy 510\ncx 320\ncy 240\nk1 0.1\nk2 -0.2\n", "500\n510\n320\n240\n0.1\n-0.2\n0\n0\n",
    "500,0 510,0 320,0 240,0 0,1 -0,2 0,0 0,0", "[500, 510, 320, 240, 0.1, -0.2, 0, 0]",
])  # fmt: skip
def test_tables_and_arrays_in_text(make, text):
    found = read_calibration(make.text("camera.csv", text))
    assert (found.fx, found.fy, found.cx, found.cy) == (500, 510, 320, 240)
    assert found.coefficients[:4] == (0.1, -0.2, 0, 0) and not any(found.coefficients[4:])


@pytest.mark.parametrize("text", [
    "[[500.   0. 320.]\n [  0. 510. 240.]\n [  0.   0.   1.]]",
    "array([[500.,   0., 320.],\n       [  0., 510., 240.],\n       [  0.,   0.,   1.]])",
])  # fmt: skip
def test_a_matrix_as_numpy_prints_it(make, text):
    found = read_calibration(make.text("k.txt", text))
    assert (found.fx, found.fy, found.cx, found.cy, found.model) == (500, 510, 320, 240, "none")


def test_arrays_that_numpy_has_saved(make):
    """As the calibration of OpenCV's tutorial is saved; what is pickled, or large, is not read."""
    K, file = np.array(json.loads(ROWS), float), make.root / "calib.npz"
    views = np.array([np.zeros(3), np.zeros(2)], dtype=object)
    np.savez(file, mtx=K, dist=np.array([FIVE]), rvecs=views, corners=np.zeros((400, 400)))
    found = read_calibration(file)
    assert (found.fx, found.fy, found.cx, found.cy) == (500, 510, 320, 240)
    assert (found.model, found.coefficients) == ("radtan", FIVE) and set(found.ignored) == {"rvecs", "corners"}
    np.savez(file, K=K, lens_warp=np.array(KC))
    with pytest.raises(DvoError, match="lens_warp"):
        read_calibration(file)
    for unread in (np.array(KC, dtype=object), np.zeros(30), np.array([1j, 0, 0, 0])):
        np.savez(file, K=K, dist=unread)
        with pytest.raises(DvoError, match="dist"):
            read_calibration(file)
    np.savez(file, K=K)
    content = file.read_bytes()
    at = content.index(b"PK\x01\x02") + 8  # flags of the first member: encrypted
    file.write_bytes(content[:at] + b"\x01" + content[at + 1 :])
    with pytest.raises(DvoError, match="not an array of NumPy"):
        read_calibration(file)
    np.save(make.root / "k.npy", K)
    assert read_calibration(make.root / "k.npy").fy == 510
    np.save(make.root / "k.npy", views, allow_pickle=True)
    with pytest.raises(DvoError, match="k.npy: calibration: not an array of NumPy without pickle"):
        read_calibration(make.root / "k.npy")


def test_a_camera_of_several_by_its_number(make):
    file = make.text("camchain.yaml", "cam0: {intrinsics: [1, 2, 3, 4]}\ncam1: {intrinsics: [5, 6, 7, 8]}\n")
    assert read_calibration(file).fx == 1 and read_calibration(f"{file}:1").fx == 5
    with pytest.raises(DvoError, match="no camera 2 in it"):
        read_calibration(f"{file}:2")
    other = KITTI_RAW + KITTI_RAW.replace("_00", "_02").replace("7.215", "7.315")
    raw = make.text("calib_cam_to_cam.txt", other)
    assert read_calibration(f"{raw}:2").fx == 731.5377
    with pytest.raises(DvoError, match="2 cameras in it: 0, 2"):
        read_calibration(raw)


def test_a_stream_of_realsense_and_a_camera_of_a_scene_by_its_number(make):
    dump = make.text("d435.txt", REALSENSE.format("Inverse Brown Conrady", "0.1 0 0 0 0"))
    depth = read_calibration(f"{dump}:0")
    assert depth.fx == 390.25830078125 and depth.ignored == ("Color 640x480",)
    scene = make.text("sfm_data.json", openmvg(("pinhole", MVG), ("pinhole", MVG | {"focal_length": 400})))
    assert read_calibration(f"{scene}:1").fx == 400
    with pytest.raises(DvoError, match="no camera 2 in it"):
        read_calibration(f"{scene}:2")
    stereo = make.text("stereo.json", json.dumps({"CameraParameters1": MATLAB, "CameraParameters2": {**MATLAB,
                       "RadialDistortion": [0, 0], "TangentialDistortion": [0, 0]}}))  # fmt: skip
    assert read_calibration(f"{stereo}:2").model == "none"


def test_the_baseline_of_middlebury_is_in_millimetres_and_needs_equal_principal_points(make):
    same = read_calibration(make.text("a.txt", MIDDLEBURY.format(320, 0)))
    assert same.baseline == pytest.approx(0.193001) and not same.notes and same.ignored[:2] == ("cam1", "ndisp")
    shifted = make.text("b.txt", MIDDLEBURY.format(451.111, 131.111))
    assert read_calibration(shifted).baseline is None and "doffs=131.111" in read_calibration(shifted).notes[0]
    right = read_calibration(f"{shifted}:1")
    assert (right.cx, right.baseline, right.notes) == (451.111, None, ())


def test_stereo_files_of_orb_slam_say_which_camera_is_read(make):
    (said,) = read_calibration(make.text("c.yaml", SLAM + STEREO)).doubts(640, 480)
    assert "rectified" in said and "LEFT" in said
    text = VSLAM.format("perspective", "").replace("0.1", "0").replace("-0.2", "0") + (
        "StereoRectifier:\n  K_left: [458, 0, 367, 0, 457, 248, 0, 0, 1]\n  D_left: [-0.28, 0.07, 0.0002, 0, 0]\n"
        "  K_right: [457, 0, 379, 0, 456, 255, 0, 0, 1]\n  D_right: [-0.28, 0.07, 0.0002, 0, 0]\n"
    )
    found = read_calibration(make.text("d.yaml", text))
    assert (found.fx, found.model) == (500, "none") and "StereoRectifier.left" in found.doubts(640, 480)[0]


def test_depth_scale_and_baseline_are_found_in_their_mappings(make):
    assert read_calibration(make.text("a.yaml", SLAM)).depth_scale == 5000
    assert read_calibration(make.text("b.yaml", SLAM.replace("DepthMap", "RGBD.DepthMap"))).depth_scale == 5000
    assert read_calibration(make.text("c.yaml", RECTIFIED)).baseline == 0.0745
    assert read_calibration(make.text("d.yaml", SLAM + "Camera.bf: 50.0\n")).baseline == 0.1


def test_the_mei_model_of_a_file_gives_its_pixels(make):
    """As camodocal's CataCamera projects: onto the sphere, then distorted, then to pixels."""
    camera = read_calibration(make.text("c.yaml", VINS_MEI)).camera(640, 480)
    X, Y, Z = 0.3, -0.2, 1.0
    z = Z + 1.9 * math.sqrt(X * X + Y * Y + Z * Z)
    x, y = X / z, Y / z
    r2, (k1, k2, p1, p2) = x * x + y * y, KC
    u = x * (1 + k1 * r2 + k2 * r2 * r2) + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * (1 + k1 * r2 + k2 * r2 * r2) + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    assert project(np.array([X, Y, Z]), camera) == pytest.approx([900 * u + 320, 910 * v + 240], abs=1e-9)


def test_a_size_that_is_no_size_is_left_out(make):
    found = read_calibration(make.text("calib_cam_to_cam.txt", KITTI_RAW.replace("1.242000e+03", "1e400")))
    assert found.width is None and found.fx == 721.5377


def test_a_large_transforms_file(make):
    text = transforms([{"sharpness": 31.123456789} for _ in range(12_000)], **FULL)
    assert len(text) > 1024**2 and read_calibration(make.text("transforms.json", text)).fx == 500


def test_the_readout_of_a_lens_profile_is_in_milliseconds(make):
    assert read_calibration(make.text("profile.json", json.dumps(GYROFLOW))).readout == 0.015


def test_a_size_whose_sides_are_exchanged_is_told_as_such(make):
    found = read_calibration(make.text("c.yaml", f"{PINHOLE}ImageSize: [480, 640]\n"))
    with pytest.raises(DvoError, match="exchange width and height in it"):
        found.camera(640, 480)
    assert "is the centre of 640x480 images" in found.doubts(480, 640)[0]
    turned = read_calibration(make.text("d.yaml", "fx: 500\nfy: 510\ncx: 239.5\ncy: 319.5\nsize: [480, 640]\n"))
    with pytest.raises(DvoError, match="turn it too"):
        turned.camera(640, 480)


@pytest.mark.parametrize(
    ("line", "note"),
    [
        ("depth_scale: 0.001", "a depth scale of 0.001 is no number of units"),
        ("baseline: 120", "a baseline of 120 m"),
        (f"D: {list(KC)}", "D has 4 numbers and no lens model is named"),
    ],
)
def test_values_in_another_unit_and_coefficients_without_a_model_are_told(make, line, note):
    found = read_calibration(make.text("c.yaml", f"{PINHOLE}{line}\n"))
    assert note in found.notes[0] and found.depth_scale is None and found.doubts(640, 480) == list(found.notes)


@pytest.mark.parametrize(("name", "text", "told"), [
    ("c.txt", "500 510 320 240 -0.3 0.1 0.08 -0.01", True), ("c.txt", "500 510 320 240 -0.3 0.1 0.02 -0.01", False),
    ("c.yaml", PINHOLE + "model: radtan\nD: [-0.3, 0.1, -0.06, 0.001, 0.002]\n", True),
    ("c.yaml", PINHOLE + "model: fisheye\nD: [-0.3, 0.1, -0.06, 0.01]\n", False),
])  # fmt: skip
def test_tangential_coefficients_of_no_lens_are_told(make, name, text, told):
    """As of a fisheye, or in the order k1 k2 k3 p1 p2."""
    notes = read_calibration(make.text(name, text)).notes
    assert any("no usual lens" in note for note in notes) == told


def test_a_file_of_a_depth_camera_alone_is_told(make):
    file = make.text("c.json", json.dumps({"depth_intrinsics": {"fx": 500, "fy": 510, "cx": 320, "cy": 240}}))
    assert "is that the camera of the images, or of depth?" in read_calibration(file).notes[0]


@pytest.mark.parametrize("line", [f"D: {list(FIVE)}", f"model: radtan\nD: {list(KC)}", "k1: 0.1\nk2: 0.1\np1: 0\np2: 0",
                                  f"fisheye: 1\nD: {list(KC)}", "depth_scale: 5000\nbaseline: 0.12", "k: [0, 0]",
                                  "undistorted: true", "rectified: true"])  # fmt: skip
def test_what_is_plain_needs_no_note(make, line):
    assert not read_calibration(make.text("c.yaml", f"{PINHOLE}{line}\n")).notes


INFO = """width: 640
height: 480
distortion_model: plumb_bob
d: [0.1, 0.0, 0.0, 0.0, 0.0]
k: [500, 0, 321, 0, 510, 241, 0, 0, 1]
roi: {{x_offset: {}, y_offset: {}, height: {}, width: {}, do_rectify: false}}
"""


@pytest.mark.parametrize(
    ("region", "principal", "size"),
    [((0, 0, 0, 0), (321, 241), (640, 480)), ((100, 50, 240, 320), (221, 191), (320, 240))],
)
def test_the_region_that_a_ros_camera_reads_out(make, region, principal, size):
    """K and size of sensor_msgs/CameraInfo are those of the whole sensor, images those of the region."""
    found = read_calibration(make.text("camera_info.yaml", INFO.format(*region)))
    assert (found.fx, found.fy, found.cx, found.cy) == (500, 510, *principal)
    assert (found.width, found.height) == size


@pytest.mark.parametrize(
    ("bins", "numbers", "size"),
    [((0, 0), (500, 510, 221, 191), (320, 240)), ((2, 2), (250, 255, 110.5, 95.5), (160, 120)),
     ((1, 4), (500, 127.5, 221, 47.75), (320, 60))],
)  # fmt: skip
def test_pixels_that_a_ros_camera_adds_up(make, bins, numbers, size):
    """As image_geometry of ROS: K is that of the whole sensor, divided behind the region."""
    binning = f"binning_x: {bins[0]}\nbinning_y: {bins[1]}\n"
    found = read_calibration(make.text("camera_info.yaml", INFO.format(100, 50, 240, 320) + binning))
    assert (found.fx, found.fy, found.cx, found.cy) == numbers and (found.width, found.height) == size
    with pytest.raises(DvoError, match="binning_x: no number of pixels"):
        read_calibration(make.text("camera_info.yaml", INFO.format(0, 0, 0, 0) + "binning_x: 1.5\n"))


def test_a_region_beyond_the_sensor(make):
    with pytest.raises(DvoError, match="roi"):
        read_calibration(make.text("camera_info.yaml", INFO.format(400, 50, 240, 320)))
