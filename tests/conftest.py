"""JAX as the product configures it, before any test imports it."""

import os
import tempfile

from sauna.system.jax_setup import configure_jax

# Not this user's own key: that of one test session and of the processes that it starts.
os.environ.setdefault("SAUNA_KEY_FILE", os.path.join(tempfile.mkdtemp(), "key"))

configure_jax()
