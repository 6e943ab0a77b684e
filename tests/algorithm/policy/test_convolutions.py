"""Convolutions on a CPU, with XLA's own as the oracle, and the frame in which XLA calls them."""

from __future__ import annotations

import threading

import jax
import jax.numpy as jnp
import numba
import numpy as np
import pytest

from sauna.algorithm.policy import compiled_convolution
from sauna.algorithm.policy.convolutions import convolution
from sauna.system import compiled

SIZES = {
    "one picture": ((1, 9, 9, 3), 3, 1),
    "no square": ((3, 7, 12, 2), 3, 1),
    "pixels left over": ((3, 12, 11, 2), 4, 3),
    "a stride that skips pixels": ((3, 11, 8, 2), 2, 3),
    "one position": ((2, 5, 5, 3), 5, 2),
    "one pixel": ((4, 1, 1, 2), 1, 1),
}


def theirs(kernel, bias, x, stride, rectified=False):
    out = jax.lax.conv_general_dilated(
        x, kernel, (stride,) * 2, "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    return jax.nn.relu(out + bias) if rectified else out + bias


def arrays(shape: tuple[int, ...], width: int, features: int = 5):
    """Kernel, bias and pictures."""
    random = np.random.default_rng(0)
    shapes = (width, width, shape[-1], features), (features,), shape
    return tuple(random.normal(size=shape).astype(np.float32) for shape in shapes)


def results(function, given: tuple, stride: int, rectified: bool):
    """What a convolution gives, and its gradients by kernel, bias and pictures."""

    def squares(*given):
        out = function(*given, stride, rectified)
        return (out**2).sum() + out.sum(), out

    return jax.jit(jax.grad(squares, (0, 1, 2), has_aux=True))(*given)


def assert_close(ours, expected) -> None:
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4 * np.abs(other).max(initial=0))


@pytest.mark.parametrize("rectified", [False, True])
@pytest.mark.parametrize("name", SIZES)
def test_a_convolution_and_its_gradients_are_xlas(name: str, rectified: bool) -> None:
    shape, width, stride = SIZES[name]
    given = arrays(shape, width)
    ours = results(convolution, given, stride, rectified)
    assert_close(ours, results(theirs, given, stride, rectified))


def test_the_last_turn_may_be_shorter() -> None:
    """A picture has 36 x 36 patches of 48 numbers: three take a turn, seven are two and a third."""
    assert compiled_convolution.of_a_turn(36 * 36 * 48, 7) == 3
    given = arrays((7, 39, 39, 3), 4)
    assert_close(results(convolution, given, 1, True), results(theirs, given, 1, True))


def test_no_pictures_have_no_gradient(capfd) -> None:
    kernel, bias, x = arrays((2, 6, 6, 3), 3)
    (by_kernel, by_bias, by_x), out = results(convolution, (kernel, bias, x[:0]), 1, True)
    assert (out.shape, by_x.shape) == ((0, 4, 4, 5), (0, 6, 6, 3))
    assert not by_kernel.any() and not by_bias.any()
    assert capfd.readouterr() == ("", "")  # where a compiled function says what it cannot raise


@pytest.mark.parametrize("high", [255.0, 3.0])
def test_bytes_are_shares_and_have_no_gradient(high: float) -> None:
    kernel, bias, _ = arrays((3, 8, 8, 2), 3)
    x = np.random.default_rng(0).integers(0, 256, (3, 8, 8, 2)).astype(np.uint8)

    def squares(kernel, bias, x):
        return (convolution(kernel, bias, x, 1, high=high) ** 2).sum()

    ours = jax.jit(jax.grad(squares, (0, 1)))(kernel, bias, x)
    assert_close(ours, jax.grad(squares, (0, 1))(kernel, bias, x.astype(np.float32) / high))
    program = str(jax.make_jaxpr(jax.grad(squares, (0, 1)))(kernel, bias, x))
    assert "f32[0,0,0,0]" in program and "f32[3,8,8,2]" in program


def test_other_numbers_are_taken_as_floats() -> None:
    kernel, bias, x = arrays((2, 6, 6, 3), 3)
    for kind in (np.int32, np.float16):
        given = (9 * x).astype(kind)
        ours = convolution(kernel, bias, given, 1)
        assert_close(ours, theirs(kernel, bias, given.astype(np.float32), 1))


def test_what_is_not_a_number_stays_so() -> None:
    kernel, bias, x = arrays((2, 6, 6, 3), 3)
    x[1, 2, 2] = np.nan
    out = np.asarray(convolution(kernel, bias, x, 1, rectified=True))
    assert np.isfinite(out[0]).all() and np.isnan(out[1, :3, :3]).all()


def test_a_vmap_takes_one_after_the_other() -> None:
    """Of the pictures alone, and of the kernels too."""
    kernel, bias, x = arrays((6, 7, 8, 2), 3)
    kernels, x = jnp.stack([kernel, 2 * kernel]), x.reshape(2, 3, 7, 8, 2)

    def gradients(kernel, x):
        return results(convolution, (kernel, bias, x), 2, True)

    alone = [gradients(kernel, x[0]), gradients(kernel, x[1])]
    for i, one in enumerate(alone):
        together = jax.tree.map(lambda a, i=i: a[i], jax.vmap(gradients, (None, 0))(kernel, x))
        jax.tree.map(np.testing.assert_array_equal, together, one)
    both = jax.vmap(gradients)(kernels, x)
    jax.tree.map(np.testing.assert_array_equal, jax.tree.map(lambda a: a[0], both), alone[0])
    assert_close(jax.tree.map(lambda a: a[1], both), gradients(2 * kernel, x[1]))


def test_a_checkpoint_computes_the_same_again() -> None:
    given = arrays((3, 7, 8, 2), 3)
    again = jax.checkpoint(lambda *given: convolution(*given, 2, True))
    ours = results(lambda kernel, bias, x, *_: again(kernel, bias, x), given, 2, True)
    jax.tree.map(np.testing.assert_array_equal, ours, results(convolution, given, 2, True))


def asked(version: tuple[int, int] | None, kind: int = 1) -> tuple[bool, tuple[int, int]]:
    """Whether the function takes a frame as a question, and which version it answers."""

    def words(*numbers: int) -> np.ndarray:
        return np.array(numbers, np.int64)

    metadata = words(40, 24, 0, -1, -1)
    extension = words(32, kind, 0, metadata.ctypes.data)
    interface = words(0, 0, 24, 0, 0)
    if version:
        interface[4:].view(np.int32)[:] = version
    frame = words(0, extension.ctypes.data, interface.ctypes.data if version else 0)

    @numba.njit
    def ask(address):
        return compiled_convolution.asks_for_the_version(compiled_convolution.words(address))

    is_asked = ask(frame.ctypes.data)
    assert metadata[4] == (0 if is_asked else -1)  # promises nothing
    return is_asked, tuple(metadata[3:4].view(np.int32))


def test_the_version_of_the_interface_is_answered() -> None:
    """XLA's own where the positions hold; where it names none, the oldest."""
    assert asked((0, 3)) == (True, (0, 3))
    assert asked((1, 3)) == (True, (0, 1))  # which such an XLA refuses
    assert asked(None) == (True, (0, 1))
    assert asked((0, 3), kind=2) == (False, (-1, -1))  # an extension of another kind


def test_threads_register_once(monkeypatch) -> None:
    """XLA refuses a second function of the same name."""
    registered = []
    monkeypatch.setattr(compiled_convolution, "_registered", {})
    monkeypatch.setattr(compiled_convolution, "compiled_for_c", lambda *_: numba.cfunc("f8()")(one))
    monkeypatch.setattr(jax.ffi, "register_ffi_target", lambda name, _: registered.append(name))
    both = [threading.Thread(target=compiled_convolution.register) for _ in range(2)]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join()
    assert registered == [compiled_convolution.FORWARD, compiled_convolution.BACKWARD]


def one() -> float:
    return 1.0


def test_without_a_folder_for_the_cache_it_is_compiled_each_time(monkeypatch) -> None:
    def refuse(_):
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr(numba.core.ccallback, "FunctionCache", refuse)
    assert compiled.compiled_for_c("f8()", one).ctypes() == 1.0
