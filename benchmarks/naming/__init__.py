"""Naming benchmark: motors with hidden effects, made without pmdc_jax, and what is said of them."""
