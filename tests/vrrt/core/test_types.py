"""Pytrees: structures of different classes differ, fields are traced or static, short texts."""

import jax
import jax.numpy as jnp
import pytest

from vrrt_jax.core.types import PytreeSubclasses, pytree, static


class Shape(PytreeSubclasses):
    """A base with a method that subclasses override."""

    size: jax.Array
    sides: int = static(default=4)

    def area(self):
        return self.size


def test_compiled_functions_never_take_one_class_for_another():
    """Also with many classes of one layout, whose hashes may collide in JAX's caches."""
    area = jax.jit(lambda shape: shape.area())
    shapes = []
    for k in range(60):

        def own_area(self, k=k):
            return k * self.size

        shapes.append(type("Shape", (Shape,), {"area": own_area})(size=jnp.float32(1.0)))
    for _ in range(2):
        assert [float(area(shape)) for shape in shapes] == list(range(60))
    first, second = (jax.tree.structure(shape) for shape in shapes[:2])
    assert first != second


def test_static_fields_are_part_of_the_structure():
    three, four = Shape(size=jnp.ones(2), sides=3), Shape(size=jnp.ones(2))
    assert jax.tree.structure(three) != jax.tree.structure(four)
    assert jax.tree.leaves(three)[0].shape == (2,)
    doubled = jax.tree.map(lambda leaf: 2 * leaf, three)
    assert isinstance(doubled, Shape) and doubled.sides == 3 and float(doubled.size[0]) == 2.0
    paths = jax.tree_util.tree_flatten_with_path(three)[0]
    assert jax.tree_util.keystr(paths[0][0]) == ".size"


def test_texts_are_short():
    @pytree
    class Pair:
        first: jax.Array
        second: Shape

    text = repr(Pair(first=jnp.zeros((1000, 7)), second=Shape(size=jnp.zeros(3))))
    assert text == "Pair(first=float32[1000, 7], second=Shape)"
    with pytest.raises(AttributeError):
        Shape(size=jnp.zeros(3)).size = 1  # type: ignore[misc] - frozen
