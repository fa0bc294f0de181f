"""Roof cameras: what they are, where the robot stands in their pictures, and how that joins the survey."""
