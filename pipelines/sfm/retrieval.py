"""Which photos of a large set are alike: a descriptor per image from its own features.

For a set of photos nothing says which of them overlap, and matching all pairs grows with the
square of their number. So each image is described by one vector, and only the nearest are matched.
The vector is a VLAD (Jegou et al., "Aggregating local descriptors into a compact image
representation", CVPR 2010) of the SIFT features that are found anyway, on words that are learned
from the same capture (so nothing is downloaded), normalised word by word (Arandjelovic and
Zisserman, "All about VLAD", CVPR 2013).

Symbols: N images, K words, D numbers of a feature (128).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipelines.sfm.pairs import Pairs

Floats = npt.NDArray[np.float32]

NUM_WORDS = 48
FEATURES_PER_IMAGE = 400
"""Features of an image that are looked at: the vector hardly changes beyond."""
_LEARN_FROM = 20_000
_ROUNDS = 8


def image_vectors(features: Sequence[npt.NDArray[np.uint8]], seed: int = 0) -> Floats:
    """One unit vector per image, [N, K * D]; zeros for an image without features.

    features: per image [n_i, D]. Memory: 24 KB per image with 48 words, and the features given.
    """
    whole = np.concatenate([part for part in features if len(part)] or [np.zeros((1, 128), "u1")])
    random = np.random.default_rng(seed)
    chosen = random.choice(len(whole), size=min(_LEARN_FROM, len(whole)), replace=False)
    words = learn_words(whole[np.sort(chosen)].astype(np.float32), NUM_WORDS, random)
    vectors = np.zeros((len(features), words.size), np.float32)
    for index, part in enumerate(features):
        if len(part):
            vectors[index] = _vlad(part.astype(np.float32), words)
    return vectors


def learn_words(samples: Floats, num_words: int, random: np.random.Generator) -> Floats:
    """Centres of `samples` [S, D] by k-means (Lloyd's), [K, D] with K <= num_words."""
    count = min(num_words, len(samples))
    words = samples[random.choice(len(samples), size=count, replace=False)]
    for _ in range(_ROUNDS):
        nearest = nearest_words(samples, words)
        sizes = np.bincount(nearest, minlength=count)
        order = np.argsort(nearest, kind="stable")
        starts = np.concatenate(([0], np.cumsum(sizes)[:-1]))
        filled = sizes > 0
        sums = np.add.reduceat(samples[order], starts[filled], axis=0)
        words[filled] = sums / sizes[filled, None]
    return words


def nearest_words(samples: Floats, words: Floats) -> npt.NDArray[np.int64]:
    """Index of the word nearest to each sample, [S]."""
    # |x - w|^2 without |x|^2, which is the same for all words.
    distances = (words**2).sum(axis=1) - 2.0 * samples @ words.T
    nearest: npt.NDArray[np.int64] = distances.argmin(axis=1)
    return nearest


def _vlad(features: Floats, words: Floats) -> Floats:
    """Sums of what features differ from their word by, each word's to unit length, [K * D]."""
    nearest = nearest_words(features, words)
    residuals = np.zeros_like(words)
    np.add.at(residuals, nearest, features - words[nearest])
    residuals /= np.maximum(np.linalg.norm(residuals, axis=1, keepdims=True), 1e-6)
    flat: Floats = residuals.ravel() / max(float(np.linalg.norm(residuals)), 1e-6)
    return flat


def retrieval_pairs(vectors: Floats, neighbours: int) -> Pairs:
    """Each image with those most like it, as many as `neighbours`, and with the next two in order.

    Edges of a maximum spanning tree are among them, so that all images hang together. vectors:
    [N, K * D] unit. Returns sorted pairs.
    """
    num = len(vectors)
    alike = vectors @ vectors.T
    np.fill_diagonal(alike, -np.inf)
    count = min(neighbours, num - 1)
    pairs = {(i, j) for step in (1, 2) for i, j in zip(range(num), range(step, num), strict=False)}
    if count > 0:
        nearest = np.argpartition(-alike, count - 1, axis=1)[:, :count]
        pairs |= {(min(i, j), max(i, j)) for i, row in enumerate(nearest.tolist()) for j in row}
    return sorted(pairs | _spanning_tree(alike))


def pairs_across(vectors: Floats, stretches: Sequence[range], neighbours: int) -> Pairs:
    """Each image with those most like it among the images of all other clips.

    vectors: [N, K * D] unit. stretches: indices of each clip, N in all. Returns sorted pairs.
    """
    alike = vectors @ vectors.T
    for clip in stretches:
        alike[clip.start : clip.stop, clip.start : clip.stop] = -np.inf
    pairs = set()
    for i, row in enumerate(alike):
        others = np.flatnonzero(np.isfinite(row))
        nearest = others[np.argsort(-row[others], kind="stable")[:neighbours]]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in nearest}
    return sorted(pairs)


def _spanning_tree(alike: Floats) -> set[tuple[int, int]]:
    """Edges (i, j), i < j, of a tree over all images that are most alike (Prim's algorithm)."""
    num = len(alike)
    outside = np.ones(num, bool)
    outside[0] = False
    best, partner = alike[0].copy(), np.zeros(num, np.int64)
    edges: set[tuple[int, int]] = set()
    for _ in range(num - 1):
        added = int(np.where(outside, best, -np.inf).argmax())
        if not outside[added]:
            added = int(outside.argmax())
        outside[added] = False
        edges.add((min(added, int(partner[added])), max(added, int(partner[added]))))
        closer = alike[added] > best
        best[closer], partner[closer] = alike[added][closer], added
    return edges
