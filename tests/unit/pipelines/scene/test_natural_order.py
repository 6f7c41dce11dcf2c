"""File names as people count them."""

from __future__ import annotations

from pipelines.scene.natural_order import natural_key


def test_numbers_count_and_capitals_do_not() -> None:
    names = ["b1.jpg", "IMG_10.jpg", "img_2.JPG", "10.jpg", "2.jpg", "a.jpg"]
    assert sorted(names, key=natural_key) == [
        "2.jpg",
        "10.jpg",
        "a.jpg",
        "b1.jpg",
        "img_2.JPG",
        "IMG_10.jpg",
    ]


def test_any_name_has_a_place_and_different_names_different_ones() -> None:
    """Superscripts and other digits are no numbers: `int` does not read all of them."""
    names = ["1\u00b2.jpg", "\u0663.jpg", "", "007", "7", "A1", "a1"]
    assert len({natural_key(name) for name in names}) == len(names)
