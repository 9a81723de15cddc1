"""Measurement models defined by ordinary differential equations, on a compiled batched integrator."""
