"""JAX as the product configures it, before any test imports it."""

from sauna.system.jax_setup import configure_jax

configure_jax()
