"""Well-known systems that pip installs, each behind :class:`dvo.odometry.protocol.Odometry`.

Their packages are imported when a system is built, and nowhere else: the harness builds systems in worker processes
only, so a crash of native code, and a licence that is not MIT, stay there.
"""
