"""No product of matrices is left to a device that would take its numbers for shorter ones."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hylios_fit import adding, analog, inversion, load_surrogate, sampling, skin, tally, walker
from hylios_fit.precision import in_full, product
from hylios_fit.skin import Specimen
from hylios_fit.statevector import state_vector

NM = np.array([420.0, 800.0, 1600.0])


def products(jaxpr):
    """(precision of each product of a program and of what it calls)."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation.params["precision"]
        for value in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")
        ):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                yield from products(inner)


def in_full_only(function, *args):
    found = list(products(jax.make_jaxpr(function)(*args).jaxpr))
    highest = (jax.lax.Precision.HIGHEST,) * 2
    return bool(found) and all(precision == highest for precision in found)


def test_what_is_counted():
    x = jnp.ones((2, 2), jnp.float32)
    assert not in_full_only(lambda x: x @ x, x)
    assert not in_full_only(jax.jit(lambda x: x + 1.0), x)
    assert in_full_only(in_full(jax.jit(lambda x: x @ x)), x)
    assert in_full_only(jax.grad(lambda x: jnp.sum(product(x, x))), x)


@pytest.mark.parametrize("way", ["value", "forward", "reverse"])
def test_adding(way):
    layers = Specimen.preset("S3").layers(NM)

    def mean(mu_a):
        found = adding.skin(layers._replace(mu_a=mu_a), order=4, dtype=jnp.float32)
        return jnp.mean(found.reflectance)

    ways = {"value": lambda f: f, "forward": jax.jacfwd, "reverse": jax.grad}
    mu_a = jnp.asarray(layers.mu_a, jnp.float32)
    assert in_full_only(ways[way](mean), mu_a)


@pytest.mark.parametrize("form", ["complex", "dispersed"])
def test_the_walk_to_the_letter(form, monkeypatch):
    specimen = Specimen.preset("S3")
    layers, melanin = specimen.layers(NM), skin.melanin_coefficient(specimen.values, NM)
    fates, given = analog._fates, []
    monkeypatch.setattr(analog, "_fates", lambda *args: given.append(args) or (0, 0))
    analog.trace(layers, jnp.asarray(melanin, jnp.float32), form, 0, jax.random.key(0), 4)
    key, one, form, incidence, rays, independent = given[0]
    assert in_full_only(lambda key: fates(key, one, form, incidence, rays, independent), key)


def test_sums_of_paths():
    layers = Specimen.preset("S3").layers(NM)
    plan = walker.plan(layers)
    paths = walker.walk(plan.layers, "complex", jax.random.key(0), rays=256, shares=plan.shares)

    def mean(mu_a):
        asked = layers._replace(mu_a=mu_a)
        return tally.collect(paths, plan.layers, asked, shares=plan.shares).mean

    assert in_full_only(mean, layers.mu_a)
    assert in_full_only(jax.jacfwd(mean), layers.mu_a)


def test_surrogate_and_fit():
    surrogate = load_surrogate().on(NM)
    member = surrogate.at("complex")
    vector = state_vector(member.names, member.lower, member.upper)
    middle = jnp.asarray(0.5 * (member.lower + member.upper), jnp.float32)
    assert in_full_only(member._evaluate, middle)
    target = jnp.asarray(member(middle), jnp.float32)
    weights = jnp.eye(target.size, dtype=jnp.float32)
    z = jnp.zeros(len(vector.free), jnp.float32)

    def fitted(start):
        return inversion._solve(member, vector, weights, target, start)

    assert in_full_only(fitted, z)
    arguments = jax.tree.map(sampling._as_array, (member, vector, weights, target))
    dynamic, static = eqx.partition(arguments, eqx.is_array)
    density = sampling._log_posterior(static)
    assert in_full_only(lambda states: density(dynamic, states), z[None])
