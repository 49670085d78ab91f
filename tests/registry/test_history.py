"""The log: its order, what counts, and that it survives what happens to the model's versions."""

from __future__ import annotations

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.registry.history import Event, counting


def event(number: int, base: int, kind: str = "promote", version: int = 1) -> Event:
    return Event(number, f"m{number}", kind, version, None, "d", base, "me@here", "why", 0.0, True)  # type: ignore[arg-type]


def test_of_two_moves_decided_on_the_same_one_the_first_counts():
    first, second, third = event(1, 0), event(2, 0), event(3, 1)
    assert counting([first, second, third]) == [first, third]


def test_a_refusal_between_two_moves_does_not_make_the_second_void():
    events = [event(1, 0), event(2, 1, "refuse"), event(3, 1)]
    assert [e.number for e in counting(events)] == [1, 3]


def test_a_move_on_a_void_one_is_void():
    assert [e.number for e in counting([event(1, 0), event(2, 0), event(3, 2)])] == [1]


@given(st.lists(st.tuples(st.integers(0, 8), st.booleans()), max_size=12))
def test_the_moves_that_count_are_a_chain(drawn):
    events = [event(i + 1, base, "promote" if moves else "refuse") for i, (base, moves) in enumerate(drawn)]
    chain = counting(events)
    assert [e.base for e in chain] == [0, *(e.number for e in chain)][: len(chain)]
    assert all(e.moves for e in chain)
    # Whoever reads the log later comes to the same beginning.
    assert counting(events[:-1]) == chain[: len(counting(events[:-1]))]


def test_an_event_is_read_as_it_was_written(history):
    assert history.events() == []
    written = history.append("refuse", 7, None, "abc", 0, "two gates failed", {"gate.ap": "FAILS", "machine": "this"})
    (read,) = history.events()
    assert read == written
    assert (read.number, read.kind, read.version, read.before, read.digest) == (1, "refuse", 7, None, "abc")
    assert read.why == "two gates failed"
    assert read.facts == {"gate.ap": "FAILS", "machine": "this"}
    assert "@" in read.who
    assert read.when_s > 1.7e9
    assert not read.done
    history.mark_done(read)
    assert history.events()[0].done


def test_events_written_at_once_have_one_order(history):
    history.append("refuse", 1, None, "d", 0, "first")
    errors: list[Exception] = []

    def write(number: int) -> None:
        try:
            history.append("refuse", number, None, "d", 0, "at once")
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=write, args=(i,)) for i in range(2, 6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    events = history.events()
    assert [e.number for e in events] == [1, 2, 3, 4, 5]
    assert sorted(e.version for e in events) == [1, 2, 3, 4, 5]


def test_an_entry_by_hand_is_named(history, versions):
    history.append("refuse", 1, None, "d", 0, "ours")
    versions.client.create_model_version(history.name, "attentionvote:///by/hand")
    with pytest.raises(ValueError, match="entry 2 of attentionvote-bracket-history must be an event of ours"):
        history.events()
