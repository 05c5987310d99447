"""Inertial measurements: preintegration, alignment with a visual trajectory, prediction of poses."""
