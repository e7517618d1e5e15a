"""Compliance control of a six-joint arm: types, kinematic model, FDCC and the fast servo loop."""
