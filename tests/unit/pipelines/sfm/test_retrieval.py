"""Images that show the same things are found from their features alone."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.sfm.retrieval import (
    image_vectors,
    learn_words,
    nearest_words,
    pairs_across,
    retrieval_pairs,
)

NUM_PLACES, SEEN = 1200, 300


def features_of_a_walk(num: int, seed: int = 0) -> tuple[list[np.ndarray], np.ndarray]:
    """Images that look at SEEN consecutive things around a circle, in an order without meaning.

    Returns their features, with noise, and where each image begins to look.
    """
    rng = np.random.default_rng(seed)
    things = rng.integers(0, 160, (NUM_PLACES, 128))
    starts = rng.permutation(np.arange(num) * NUM_PLACES // num)
    images = []
    for start in starts:
        seen = things[(start + np.arange(SEEN)) % NUM_PLACES]
        noisy = seen + rng.normal(0, 12, seen.shape)
        images.append(rng.permutation(np.clip(noisy, 0, 255).astype(np.uint8)))
    return images, starts


def distance_around(starts: np.ndarray) -> np.ndarray:
    gap = np.abs(starts[:, None] - starts[None])
    return np.minimum(gap, NUM_PLACES - gap)


def test_the_nearest_neighbours_of_every_image_are_among_its_pairs() -> None:
    images, starts = features_of_a_walk(60)
    pairs = set(retrieval_pairs(image_vectors(images), neighbours=6))
    gaps = distance_around(starts)
    np.fill_diagonal(gaps, NUM_PLACES)
    for image in range(60):
        for other in np.argsort(gaps[image], kind="stable")[:2]:
            assert (min(image, other), max(image, other)) in pairs


def test_few_pairs_are_of_images_that_share_nothing() -> None:
    images, starts = features_of_a_walk(60)
    pairs = retrieval_pairs(image_vectors(images), neighbours=6)
    gaps = distance_around(starts)
    in_order = {(i, i + step) for step in (1, 2) for i in range(60)}
    chosen = [pair for pair in pairs if pair not in in_order]
    assert sum(gaps[pair] < SEEN for pair in chosen) > 0.95 * len(chosen)
    assert len(pairs) < 60 * 59 / 2 / 3


def test_pairs_hold_all_images_together_where_groups_share_nothing() -> None:
    rng = np.random.default_rng(1)
    centers = rng.normal(size=(3, 40))
    vectors = np.repeat(centers, 8, axis=0) + 0.05 * rng.normal(size=(24, 40))
    vectors = vectors[rng.permutation(24)] / np.linalg.norm(vectors, axis=1, keepdims=True)
    alike = vectors @ vectors.T
    pairs = retrieval_pairs(vectors.astype(np.float32), neighbours=1)
    reached, waiting = {0}, [0]
    while waiting:
        here = waiting.pop()
        for i, j in pairs:
            there = j if i == here else i if j == here else here
            if there not in reached:
                reached.add(there)
                waiting.append(there)
    assert reached == set(range(24))
    best = np.unravel_index(np.argmax(alike - 9 * np.eye(24)), alike.shape)
    assert (min(best), max(best)) in pairs


def test_the_spanning_tree_is_the_heaviest_there_is() -> None:
    """Against Kruskal's algorithm: sort all edges, take each that joins two parts."""
    rng = np.random.default_rng(2)
    vectors = rng.normal(size=(9, 5))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    alike = vectors @ vectors.T
    part = list(range(9))
    tree = set()
    edges = [(i, j) for i in range(9) for j in range(i + 1, 9)]
    for i, j in sorted(edges, key=lambda edge: -alike[edge]):
        if part[i] != part[j]:
            tree.add((i, j))
            part = [part[i] if label == part[j] else label for label in part]
    assert tree <= set(retrieval_pairs(vectors.astype(np.float32), neighbours=1))


def test_vectors_do_not_depend_on_the_order_of_features() -> None:
    images, _ = features_of_a_walk(8)
    vectors = image_vectors([*images, images[0][::-1]])
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, rtol=1e-5)
    assert vectors[0] @ vectors[-1] == pytest.approx(1.0, abs=1e-4)


def test_an_image_without_features_still_has_its_neighbours_in_order() -> None:
    images, _ = features_of_a_walk(6)
    images[3] = np.zeros((0, 128), np.uint8)
    vectors = image_vectors(images)
    assert not vectors[3].any()
    assert {(2, 3), (3, 4)} <= set(retrieval_pairs(vectors, neighbours=2))


def test_without_any_features_and_for_one_image_nothing_breaks() -> None:
    empty = [np.zeros((0, 128), np.uint8)] * 3
    assert retrieval_pairs(image_vectors(empty), 5) == [(0, 1), (0, 2), (1, 2)]
    assert retrieval_pairs(np.ones((1, 4), np.float32), 5) == []


def test_words_are_the_means_of_what_is_nearest_to_them() -> None:
    rng = np.random.default_rng(3)
    centers = 100.0 * np.eye(4, 6)
    samples = (np.repeat(centers, 50, axis=0) + rng.normal(size=(200, 6))).astype(np.float32)
    words = learn_words(samples, 3, np.random.default_rng(0))
    slow = [min(range(3), key=lambda k: float(((s - words[k]) ** 2).sum())) for s in samples]
    assert nearest_words(samples, words).tolist() == slow
    for word in range(3):
        mine = samples[np.array(slow) == word]
        np.testing.assert_allclose(words[word], mine.mean(axis=0), atol=1.0)


def test_each_image_is_paired_with_its_like_of_the_other_clips_alone() -> None:
    """Of one walk every third image is a clip: what is most like an image is of its neighbours."""
    images, starts = features_of_a_walk(60)
    order = np.argsort(starts)
    clips = [range(0, 20), range(20, 40), range(40, 60)]
    arranged = np.concatenate([order[offset::3] for offset in range(3)])
    pairs = pairs_across(image_vectors([images[i] for i in arranged]), clips, neighbours=3)
    clip_of = np.arange(60) // 20
    assert all(i < j and clip_of[i] != clip_of[j] for i, j in pairs)
    assert {index for pair in pairs for index in pair} == set(range(60))
    gaps = distance_around(starts[arranged])
    assert np.mean([gaps[pair] < SEEN / 2 for pair in pairs]) > 0.9
    assert pairs_across(np.ones((3, 4), np.float32), [range(3)], 5) == []
