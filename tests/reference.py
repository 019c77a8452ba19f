"""A slow, literal reading of the paper in scalar NumPy, independent of the package's code.

Chen et al. 2015, section 4. Everything is in Cartesian coordinates with z into the skin, and every
law is drawn by rejection from its printed density. Nothing here imports hylios_fit.
"""

import math

import numpy as np
from scipy import integrate, stats


def chi_square(samples, edges, cdf) -> float:
    """p-value that the samples follow the cumulative distribution, by counts between the edges."""
    samples = np.asarray(samples, float)
    assert np.all((samples >= edges[0]) & (samples <= edges[-1])), "samples outside their range"
    observed, _ = np.histogram(samples, edges)
    expected = np.diff(cdf(np.asarray(edges))) * len(samples)
    assert expected.min() > 5
    return stats.chisquare(observed, expected * observed.sum() / expected.sum()).pvalue


def cumulative(density, low, high, size=20_001):
    """Numerical cumulative distribution of an unnormalised density."""
    x = np.linspace(low, high, size)
    c = integrate.cumulative_trapezoid(density(x), x, initial=0.0)
    return lambda at: np.interp(at, x, c / c[-1])


def fresnel(theta_i, n1, n2):
    """Reflectance of unpolarised light by the sine and tangent formulas."""
    if n1 == n2:
        return 0.0
    sin_t = n1 / n2 * math.sin(theta_i)
    if sin_t >= 1.0:
        return 1.0
    theta_t = math.asin(sin_t)
    if theta_i < 1e-6:
        return ((n1 - n2) / (n1 + n2)) ** 2
    r_s = -math.sin(theta_i - theta_t) / math.sin(theta_i + theta_t)
    r_p = math.tan(theta_i - theta_t) / math.tan(theta_i + theta_t)
    return 0.5 * (r_s**2 + r_p**2)


def refract(u, normal, n1, n2):
    """Snell's law for a normal that points to where the ray comes from."""
    cos_i = -float(u @ normal)
    tangent = u + cos_i * normal
    sin_t = n1 / n2 * tangent
    return sin_t - math.sqrt(max(0.0, 1.0 - float(sin_t @ sin_t))) * normal


def algorithm_1(rng, theta_0):
    """As printed."""
    phi = math.atan(theta_0)
    top = (1.0 / theta_0) * math.exp(-phi / theta_0) * math.sin(phi)
    while True:
        xi_3, xi_4 = rng.random(), rng.random()
        theta = math.pi * xi_3
        if top * xi_4 <= (1.0 / theta_0) * math.exp(-theta / theta_0) * math.sin(theta):
            return theta


def algorithm_2(rng):
    """As printed."""
    while True:
        xi_5, xi_6 = rng.random(), rng.random()
        theta = math.pi * xi_5
        if xi_6 <= (3.0 * math.sqrt(6.0) / 8.0) * (1.0 + math.cos(theta) ** 2) * math.sin(theta):
            return theta


def facet_angle(rng, s):
    """Polar angle of a surface facet from Eq. 8, by rejection over the tangent's quantile."""
    while True:  # proposals s tan(theta) of a Cauchy law follow the peak at small s
        theta = math.atan(s * math.tan(0.5 * math.pi * rng.random()))
        proposal = s / (s**2 * math.cos(theta) ** 2 + math.sin(theta) ** 2)
        law = s**4 / (s**2 * math.cos(theta) ** 2 + math.sin(theta) ** 2) ** 2 * math.sin(theta)
        # law / proposal = s^3 sin / (s^2 cos^2 + sin^2), which is at most s^2 / (2 sqrt(1 - s^2))
        most = s**2 / (2.0 * math.sqrt(1.0 - s**2)) if s < 0.7 else s**3
        if rng.random() * most <= law / proposal:
            return theta


def spheroid_surface(a, b):
    """Surface of a prolate spheroid by integrating its meridian."""

    def ring(t):
        return a * math.sin(t) * math.hypot(a * math.cos(t), b * math.sin(t))

    return 2.0 * math.pi * integrate.quad(ring, 0.0, math.pi)[0]


def about(rng, axis, cos):
    """A direction at the polar cosine `cos` from `axis`, at a uniform azimuth."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.5 else np.array([0.0, 1.0, 0.0])
    p = np.cross(axis, helper)
    p /= np.linalg.norm(p)
    q = np.cross(axis, p)
    phi = 2.0 * math.pi * rng.random()
    sin = math.sqrt(max(0.0, 1.0 - cos**2))
    return cos * axis + sin * (math.cos(phi) * p + math.sin(phi) * q)


def orientation(rng, a, b):
    """Cosine between ray and major axis from Eq. 5, over the sphere, by rejection."""
    side, end = math.pi * a * b, math.pi * a * a
    while True:
        c = rng.random()
        if rng.random() * side <= side * (1.0 - c) + end * c:
            return c


def trace_inside(rng, a, b, mu, index_ratio):
    """One ray along z through a spheroid about the origin: (survived, path length inside)."""
    cos = orientation(rng, a, b)
    sin = math.sqrt(1.0 - cos**2)
    turn = 2.0 * math.pi * rng.random()
    axis = np.array([sin * math.cos(turn), sin * math.sin(turn), cos])
    form = np.eye(3) / a**2 + (1.0 / b**2 - 1.0 / a**2) * np.outer(axis, axis)
    u = np.array([0.0, 0.0, 1.0])
    while True:  # a point of the shadow, from the square around it
        start = np.array([b * (2 * rng.random() - 1), b * (2 * rng.random() - 1), -2.0 * b])
        p, q, r = u @ form @ u, start @ form @ u, start @ form @ start - 1.0
        if q * q - p * r > 0.0:
            break
    x = start + (-q - math.sqrt(q * q - p * r)) / p * u  # the first of the two points
    path = 0.0
    while True:
        length = -2.0 * (x @ form @ u) / (u @ form @ u)
        path += length
        if mu > 0.0 and -math.log(1.0 - rng.random()) / mu < length:
            return False, path
        x = x + length * u
        inward = -(form @ x)
        inward /= np.linalg.norm(inward)
        theta_i = math.acos(min(1.0, max(0.0, -float(u @ inward))))
        if rng.random() >= fresnel(theta_i, index_ratio, 1.0):
            return True, path
        mirrored = u - 2.0 * (u @ inward) * inward
        while True:
            u = about(rng, mirrored, math.cos(math.acos(math.sqrt(1.0 - rng.random()))))
            if u @ inward >= 0.0:
                break


def skin_walk(rng, thickness, index, mu_a, mu_fibre, bottom, roughness, incidence):
    """One ray into skin without melanosomes: "top" (reflected at once), "out" or "lost"."""
    bounds = np.concatenate([[0.0], np.cumsum(thickness)])
    air_and_layers = [1.0, *index]
    layer = -1  # the air
    u = np.array([math.sin(incidence), 0.0, math.cos(incidence)])
    z, fibre_met, at_once = 0.0, False, True
    while True:
        # the interface ahead
        down = u[2] > 0
        beyond = layer + 1 if down else layer - 1
        if beyond == 6:
            if rng.random() >= bottom:
                return "lost"
            u = about(rng, np.array([0.0, 0.0, -1.0]), math.sqrt(1.0 - rng.random()))
        else:
            n1, n2 = air_and_layers[layer + 1], air_and_layers[beyond + 1]
            mean_normal = np.array([0.0, 0.0, -1.0 if down else 1.0])
            while True:
                normal = mean_normal
                if {layer, beyond} == {-1, 0} and roughness > 0:
                    normal = about(rng, mean_normal, math.cos(facet_angle(rng, roughness)))
                cos_i = -float(u @ normal)
                if cos_i <= 0.0:
                    continue
                reflected = rng.random() < fresnel(math.acos(min(1.0, cos_i)), n1, n2)
                new = u + 2.0 * cos_i * normal if reflected else refract(u, normal, n1, n2)
                if (new[2] > 0) == (down != reflected):
                    break
            u = new / np.linalg.norm(new)
            if not reflected:
                layer = beyond
            if layer == -1:
                return "top" if at_once else "out"
        at_once, fibre_met = False, False
        # events until the next interface
        while True:
            ahead = ((bounds[layer + 1] if u[2] > 0 else bounds[layer]) - z) / u[2]
            absorber = -math.log(1.0 - rng.random()) / mu_a[layer] if mu_a[layer] else math.inf
            fibre = math.inf
            if layer == 4 and not fibre_met and mu_fibre:
                fibre = -math.log(1.0 - rng.random()) / mu_fibre
            if ahead <= min(absorber, fibre):
                z = bounds[layer + 1] if u[2] > 0 else bounds[layer]
                break
            if absorber < fibre:
                return "lost"
            z += fibre * u[2]
            fibre_met = True
            u = about(rng, u, math.cos(algorithm_2(rng)))
