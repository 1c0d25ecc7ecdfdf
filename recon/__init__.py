"""Reconstruction mathematics: arrays in, arrays out; no clock, file, socket or environment."""
