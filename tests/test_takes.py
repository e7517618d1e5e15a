"""Collecting: each seed is kept once, whatever is thrown away meanwhile."""

from hypothesis import given
from hypothesis import strategies as st

from studio.takes import Collection


def test_a_take_that_was_thrown_away_does_not_count_and_its_seed_comes_again() -> None:
    collection = Collection()
    collection.start(3, seed=10, countdown=0.0)
    collection.kept("a", 10, 0.0)
    collection.kept("b", 11, 0.0)
    assert (collection.done, collection.seed) == (2, 12)
    collection.trashed("a")
    assert (collection.done, collection.seed) == (1, 10)
    collection.kept("c", 10, 0.0)
    assert (collection.done, collection.seed) == (2, 12)
    collection.kept("d", 12, 0.0)
    assert not collection.is_running


def test_a_take_that_came_back_counts_again() -> None:
    collection = Collection()
    collection.start(3, seed=0, countdown=0.0)
    collection.kept("a", 0, 0.0)
    collection.trashed("a")
    collection.restored("a")
    assert (collection.done, collection.seed) == (1, 1)


def test_takes_of_others_change_nothing() -> None:
    collection = Collection()
    collection.start(2, seed=0, countdown=0.0)
    collection.trashed("older")
    collection.restored("older")
    assert (collection.done, collection.seed) == (0, 0)
    collection.kept("by hand", 77, 0.0)  # somebody reset to another seed: it counts, and 0 is still to come
    assert (collection.done, collection.seed) == (1, 0)


@given(st.lists(st.booleans(), max_size=60), st.integers(1, 8))
def test_in_the_end_each_seed_is_kept_once(throws_away: list[bool], count: int) -> None:
    collection, kept = Collection(), dict[str, int]()
    collection.start(count, seed=5, countdown=0.0)
    for number in range(200):
        if not collection.is_running:
            break
        kept[f"take {number}"] = seed = collection.seed
        collection.kept(f"take {number}", seed, 0.0)
        if number < len(throws_away) and throws_away[number] and collection.is_running:
            thrown = next(iter(kept))
            del kept[thrown]
            collection.trashed(thrown)
    assert sorted(kept.values()) == list(range(5, 5 + count))
