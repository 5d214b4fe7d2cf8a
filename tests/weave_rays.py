"""Visibility of a weave section in closed form, and by casting rays over its profile: slow, and independent of it."""

import numpy as np
from numba import njit

from nishiki.weave.section import visible_share

LINE, ARC = 0.0, 1.0


def pieces_of(section):
    """Straight pieces (0, x, z, x, z) and arcs (1, centre, angles from the vertical) of a period; period; radius.

    Written down from the drawing, not from the package's own list.
    """
    a, flank, radius = section.theta_a, section.l, section.r
    flat, yarns = getattr(section, "m", 0.0), round(getattr(section, "n", 1))
    contact = getattr(section, "contact", np.pi / 2)
    half = flank * np.cos(a) + radius * np.sin(a)
    top = flank * np.sin(a) + radius * (1 - np.cos(a))
    cloth, x = [], 0.0
    for hump in range(2):
        row, gap = (yarns, flat) if hump == 0 else (1, 0.0)
        cloth.append((LINE, x, 0.0, x + flank * np.cos(a), flank * np.sin(a)))
        centre = x + half
        for k in range(row):
            left, right = (a if k == 0 else contact), (a if k == row - 1 else contact)
            cloth.append((ARC, centre, top - radius, -left, 0.0))
            if gap > 0:
                cloth.append((LINE, centre, top, centre + gap, top))
                centre += gap
            cloth.append((ARC, centre, top - radius, 0.0, right))
            centre += 2 * radius * np.sin(contact) if k < row - 1 else 0.0
        x = centre + half
        cloth.append((LINE, x - flank * np.cos(a), flank * np.sin(a), x, 0.0))
    return np.array(cloth), x, radius


@njit
def along(piece, radius, u):
    """Point and outward normal of one piece at u in 0..1."""
    if piece[0] == LINE:
        dx, dz = piece[3] - piece[1], piece[4] - piece[2]
        size = max(np.hypot(dx, dz), 1e-300)
        return piece[1] + u * dx, piece[2] + u * dz, -dz / size, dx / size
    angle = piece[3] + u * (piece[4] - piece[3])
    sine, cosine = np.sin(angle), np.cos(angle)
    return piece[1] + radius * sine, piece[2] + radius * cosine, sine, cosine


@njit
def cast(cloth, period, radius, own, u, theta):
    """Is the point seen from theta (signed)? Its ray against the cloth one period to either side.

    One period suffices: a blocker further away, moved towards the point by whole periods, stands higher above the ray.
    """
    x, z, nx, nz = along(cloth[own], radius, u)
    rx, rz = np.sin(theta), np.cos(theta)
    if nx * rx + nz * rz <= 0:
        return False
    for shift in (-period, 0.0, period):
        for k in range(len(cloth)):
            piece = cloth[k]
            if k == own and shift == 0.0:
                continue  # a convex piece hides none of its own points but those that are turned away
            wx, wz = x - piece[1] - shift, z - piece[2]
            if piece[0] == LINE:
                dx, dz = piece[3] - piece[1], piece[4] - piece[2]
                det = rx * dz - rz * dx
                if abs(det) > 1e-300 and (wz * dx - wx * dz) / det > 1e-9 and 0 < (wz * rx - wx * rz) / det < 1:
                    return False
                continue
            b = wx * rx + wz * rz
            inside = b * b - (wx * wx + wz * wz - radius**2)
            if inside <= 0:
                continue
            for root in (-np.sqrt(inside), np.sqrt(inside)):
                distance = root - b
                angle = np.arctan2(wx + distance * rx, wz + distance * rz)
                if distance > 1e-9 and piece[3] < angle < piece[4]:
                    return False
    return True


@njit
def seen_from_all(cloth, period, radius, own, u, angles):
    for theta in angles:
        if not cast(cloth, period, radius, own, u, theta):
            return False
    return True


@njit
def share(cloth, lengths, period, radius, angles, start):
    """Changes of visibility along each piece found between the points `start` and bisected to 1e-12."""
    visible = 0.0
    for own in range(len(cloth)):
        here = seen_from_all(cloth, period, radius, own, start[0], angles)
        shown = start[0] if here else 0.0
        for k in range(1, start.size):
            low, high = start[k - 1], start[k]
            there = seen_from_all(cloth, period, radius, own, high, angles)
            if there != here:
                for _ in range(40):
                    middle = 0.5 * (low + high)
                    if seen_from_all(cloth, period, radius, own, middle, angles) == here:
                        low = middle
                    else:
                        high = middle
            else:
                low = high
            shown += (low - start[k - 1]) * here + (start[k] - low) * there
            here = there
        visible += lengths[own] * (shown + (1.0 - start[-1]) * here)
    return visible / lengths.sum()


ENDS = np.geomspace(1e-9, 0.02, 12)
START = np.concatenate([ENDS, np.linspace(0.03, 0.97, 30), 1 - ENDS[::-1]])


def lengths_of(cloth, radius):
    straight = np.hypot(cloth[:, 3] - cloth[:, 1], cloth[:, 4] - cloth[:, 2])
    return np.where(cloth[:, 0] == LINE, straight, radius * (cloth[:, 4] - cloth[:, 3]))


def brute_force(section, *angles):
    """Share of the section's length that is seen from every one of the angles."""
    cloth, period, radius = pieces_of(section)
    return share(cloth, lengths_of(cloth, radius), period, radius, np.array(angles, float), START)


def masking(section, theta):
    """G: share of a section's length that is seen from theta (radians, any shape, sign of no effect)."""
    return visible_share(section.shape, np.asarray(theta, np.float64))
