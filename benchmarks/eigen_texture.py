"""Eigen-texture (K. Nishino, Y. Sato, K. Ikeuchi, IEEE TPAMI 23(11), 2001): principal components of each patch.

A patch's observations are the rows of a matrix (observations, texels x channels). Its best approximation with k
components keeps k basis pictures and k weights an observation: k (texels x channels + observations) numbers. Which
components are kept is decided over all patches at once, by the energy that one stored number saves. Invisible texels
are filled by the approximation itself, as for the wavelets.
"""

from dataclasses import dataclass

import numpy as np

FILLS = 6


@dataclass(frozen=True)
class EigenPatch:
    """left (observations, k) scaled by the singular values, right (k, texels x channels), mean (1, texels x channels).

    energies (k,): what each component is worth; numbers: how many numbers one component stores.
    """

    left: np.ndarray
    right: np.ndarray
    mean: np.ndarray
    energies: np.ndarray
    numbers: int

    def decode(self, count: int) -> np.ndarray:
        """(observations, texels x channels) from the first `count` components; none: the mean picture."""
        return self.mean + self.left[:, :count] @ self.right[:count]


def eigen_patch(values: np.ndarray, visible: np.ndarray, *, components: int) -> EigenPatch:
    """Principal components of a patch (observations, rows, columns, channels) whose `visible` samples are known.

    Texels seen by no observation are 0. `components`: how many the filling assumes (and at most how many exist).
    """
    observations, channels = values.shape[0], values.shape[-1]
    table = values.reshape(observations, -1).astype(np.float64)
    known = np.repeat(visible.reshape(observations, -1), channels, axis=1)
    seen = known.sum(0)
    mean = np.where(seen > 0, (table * known).sum(0) / np.maximum(seen, 1), 0.0)
    complete = np.where(known, table, mean)
    for _ in range(FILLS):
        left, sizes, right = np.linalg.svd(complete - mean, full_matrices=False)
        low = (left[:, :components] * sizes[:components]) @ right[:components]
        complete = np.where(known, table, mean + low)
    left, sizes, right = np.linalg.svd(complete - mean, full_matrices=False)
    return EigenPatch(left * sizes, right, mean[None], sizes**2, table.shape[1] + observations)


def kept_components(patches: list[EigenPatch], budget: int) -> list[int]:
    """How many components of each patch fit a budget of stored numbers, the most valuable ones first.

    The mean pictures of all patches are always stored, and counted.
    """
    worth = np.concatenate([patch.energies / patch.numbers for patch in patches])
    owner = np.repeat(np.arange(len(patches)), [len(patch.energies) for patch in patches])
    cost = np.array([patch.numbers for patch in patches])[owner]
    spent = sum(patch.mean.size for patch in patches)
    order = np.argsort(-worth, kind="stable")
    fits = spent + np.cumsum(cost[order]) <= budget
    return np.bincount(owner[order[fits]], minlength=len(patches)).tolist()
