"""Clouds that meet: registration, fusion, the voxel map."""
