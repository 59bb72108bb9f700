"""Naming benchmark: motors with hidden effects, simulated without pmdc_jax, and the diagnoses of them."""
