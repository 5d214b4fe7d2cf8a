"""How much of a woven cross-section is seen from a direction: closed forms, element by element.

A section is a train of two humps of equal height a period. A hump is a straight flank of slope theta_a and length l,
an arc of radius r and angle theta_a, and the mirror image of both (Takeda and Tanaka, figs. 5 and 6). The first hump
may carry a flat
top of length m between its arcs, or be a row of n yarns: n - 1 contacts, each of two further arcs of angle `contact`.
From any direction what is seen of one side of a hump is one piece that begins at its top, so a single length says all:
that is why two directions (lamp and camera) cost no more than one, the smaller of the two lengths is lit and seen.

Derivation, with t = pi/2 - theta the angle of the ray above the horizontal and u = (sin t, cos t) normal to the ray.
A ray that leaves the arc (centre C) where it is tangent has u.p = u.C + r. With the valley at the origin and
C = (-l cos theta_a - r sin theta_a, l sin theta_a - r cos theta_a) it meets the next flank, s (cos theta_a,
sin theta_a), at s = (l sin(theta_a - t) + r (1 - cos(theta_a - t))) / sin(theta_a + t), and where that is beyond l the
next arc at the angle t2 from its top with r (1 - cos(t + t2)) = u.(C' - C) = 2 sin t (l cos theta_a + r sin theta_a).
1 - cos x is written 2 sin^2(x / 2), so that nothing cancels at grazing directions.
"""

from math import asin, cos, pi, sin, sqrt

from numba import njit

HALF_PI = 0.5 * pi


@njit(cache=True, nogil=True, error_model="numpy")
def facing_length(theta_a, length, radius, theta):
    """Length seen from the top down on the side of a hump that faces the viewer; theta >= 0, from the normal."""
    t = HALF_PI - theta
    arc = radius * theta_a
    if t < 0.0:
        return 0.0
    if t > theta_a:
        return arc + length
    turned = sin(0.5 * (theta_a - t))
    shade = length * sin(theta_a - t) + 2.0 * radius * turned * turned
    reach = sin(theta_a + t)
    if shade <= length * reach:
        return max(arc + length - (shade / reach if reach > 0.0 else 0.0), 0.0)  # without an arc 0 but for rounding
    rise = sin(t) * (length * cos(theta_a) / radius + sin(theta_a))
    seen = 2.0 * asin(sqrt(min(rise, 1.0))) - t
    return radius * min(max(seen, 0.0), theta_a)


@njit(cache=True, nogil=True, error_model="numpy")
def averted_length(theta_a, length, radius, theta):
    """Length seen from the top down on the side of a hump that is turned away from the viewer; theta >= 0."""
    t = HALF_PI - theta
    if t > theta_a:
        return radius * theta_a + length
    return radius * max(t, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def facing_contact(contact, theta):
    """Angle seen from the top down on a contact arc that faces the viewer; theta >= 0.

    For contact = pi/2 it is theta + arcsin(2 cos theta - 1), written without cancellation.
    """
    t = HALF_PI - theta
    if t < 0.0:
        return 0.0
    if t > contact:
        return contact
    seen = 2.0 * asin(sqrt(min(sin(t) * sin(contact), 1.0))) - t
    return min(max(seen, 0.0), contact)


@njit(cache=True, nogil=True, error_model="numpy")
def averted_contact(contact, theta):
    """Angle seen from the top down on a contact arc that is turned away from the viewer; theta >= 0."""
    return min(max(HALF_PI - theta, 0.0), contact)


@njit(cache=True, nogil=True, error_model="numpy")
def side_lengths(shape, theta):
    """What is seen from signed theta: (length on the + side, on the - side, contact angle on + side, on - side).

    shape: (theta_a, l, r, m, n, contact).
    """
    theta_a, length, radius, _, _, contact = shape
    far = abs(theta)
    facing, averted = facing_length(theta_a, length, radius, far), averted_length(theta_a, length, radius, far)
    near_arc, far_arc = facing_contact(contact, far), averted_contact(contact, far)
    if theta >= 0.0:
        return facing, averted, near_arc, far_arc
    return averted, facing, far_arc, near_arc


@njit(cache=True, nogil=True, error_model="numpy")
def total_length(shape):
    """Surface length of one period: 4 l + 4 a + m + (n - 1) 2 r contact."""
    theta_a, length, radius, flat, yarns, contact = shape
    return 4.0 * (length + radius * theta_a) + flat + 2.0 * (yarns - 1.0) * radius * contact


@njit(cache=True, nogil=True, error_model="numpy")
def visible_share(shape, theta_i, theta_r):
    """Share of the surface that is lit from theta_i and seen from theta_r (signed), 0 to 1."""
    if abs(theta_i) > HALF_PI or abs(theta_r) > HALF_PI:
        return 0.0
    lit, seen = side_lengths(shape, theta_i), side_lengths(shape, theta_r)
    humps = 2.0 * (min(lit[0], seen[0]) + min(lit[1], seen[1]))
    contacts = (shape[4] - 1.0) * shape[2] * (min(lit[2], seen[2]) + min(lit[3], seen[3]))
    return min((humps + shape[3] + contacts) / total_length(shape), 1.0)
