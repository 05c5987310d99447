"""Salts: the second number of every seed, one for each random draw.

``numpy.random.default_rng([seed, SALT])`` gives streams that are independent of each other, so that an option that
draws more numbers from one stream leaves the others as they are. A salt belongs to one stream: changing it changes the
bytes of what is drawn from it (rendered suites and training clips are kept by their bytes).
"""

from __future__ import annotations

# Textures
POOL = 7001  # which pattern or photograph each texture of a pool is
TEXTURE = 7002  # one texture
FOLDER = 7003  # photographs taken from a large folder
# Scenes
SCENE = 7101  # family and layout
# Motion
PATH = 7201  # short path of a training clip
LONG_PATH = 7202  # long path of a sequence
NATURAL_PATH = 7203  # motion of a hand or a quadrotor
# Training clips
CLIP = 7301  # path, intrinsics, sensor
CLIP_DEGRADATION = 7302  # compression and exposure changes
CLIP_CONDITIONS = 7303  # moving bodies and low light
CLIP_SURROUNDINGS = 7304  # what is drawn over the scene, and its clock
CLIP_CROP = 7305  # offset of the crop of a stabilised video
CLIP_BARE = 7306  # bare surfaces and long exposures
# Sequences
SEQUENCE = 7401  # scene, path, intrinsics, sensor
NOISE = 7402  # noise of one frame
DROPPED = 7403  # lost frames
LIGHTING = 7404  # exposure changes
REPAINT = 7405  # surfaces that lose their texture
LENS = 7406  # distortion coefficients
CROP = 7407  # offset of the crop of a stabilised video
# Moving bodies and meshes
MOVERS = 7501  # shape and motion of bodies
MESH_TEXTURE = 7502  # procedural replacement of a missing texture
SURROUNDINGS = 7503  # water, clouds, leaves, people, a bonnet, rain
# Ground truth and export
TRACKS = 7601  # points that are followed
IMU = 7602  # inertial noise
MESH_SEQUENCE = 7603  # path and intrinsics of a sequence of a mesh
