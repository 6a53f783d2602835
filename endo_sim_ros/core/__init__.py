"""Cameras, Gaussians, light, frames, drawing, option schema, device: what all other rooms build upon."""
