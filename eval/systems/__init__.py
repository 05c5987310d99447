"""Systems that are compared: baselines, peers, the learned odometry. Start in ``system.py``, then ``registry.py``."""
