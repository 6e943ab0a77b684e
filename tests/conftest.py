"""JAX as the product configures it, before any test imports it."""

from sauna.worker import configure_jax

configure_jax()
