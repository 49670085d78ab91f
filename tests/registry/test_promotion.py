"""The champion as it moves: forward, back, at the same time, after a crash, by hand, after deletions."""

from __future__ import annotations

import pytest

from attentionvote.registry.promotion import Superseded, move, stand, target


@pytest.fixture
def three(versions, make_model):
    """Three registered versions."""
    return [versions.register(make_model(t), {}) for t in (0.5, 0.6, 0.7)]


def promote(versions, history, version, kind="promote"):
    return move(versions, history, stand(versions, history), kind, version, "test")


def test_a_promotion_moves_the_alias_and_is_told(versions, history, three):
    promote(versions, history, three[0])
    event = promote(versions, history, three[1])
    assert versions.champion() == three[1]
    assert (event.version, event.before, event.base) == (2, 1, 1)
    assert [e.done for e in history.events()] == [True, True]
    standing = stand(versions, history)
    assert (standing.champion, standing.previous, standing.ever, standing.astray) == (three[1], (1,), (1, 2), "")


def test_of_two_promotions_at_once_one_wins_and_the_other_is_told(versions, history, three):
    promote(versions, history, three[0])
    ours, theirs = stand(versions, history), stand(versions, history)
    move(versions, history, theirs, "promote", three[1], "faster")
    with pytest.raises(Superseded, match=r"but the promote of version 2 by .* came first: run the same command again"):
        move(versions, history, ours, "promote", three[2], "slower")
    assert versions.champion() == three[1]
    promote(versions, history, three[2])
    assert versions.champion() == three[2]


def test_the_first_promotions_at_once_have_one_winner_too(versions, history, three):
    nobody = stand(versions, history)
    assert nobody.champion is None
    move(versions, history, nobody, "promote", three[0], "first")
    with pytest.raises(Superseded):
        move(versions, history, nobody, "promote", three[1], "second")
    assert versions.champion() == three[0]


def test_rollbacks_go_back_step_by_step(versions, history, three):
    for version in three:
        promote(versions, history, version)
    for expected in (three[1], three[0]):
        standing = stand(versions, history)
        version = target(versions, standing, None)
        assert version.number == expected.number
        move(versions, history, standing, "rollback", version, "back")
        assert versions.champion().number == expected.number
    with pytest.raises(ValueError, match=r"needs an earlier champion that still exists, got one of 2, 3"):
        target(versions, stand(versions, history), None)
    assert target(versions, stand(versions, history), 3).number == 3


def test_a_promotion_after_a_rollback_goes_back_to_where_it_came_from(versions, history, three):
    promote(versions, history, three[0])
    promote(versions, history, three[1])
    promote(versions, history, three[0], "rollback")
    promote(versions, history, three[2])
    assert stand(versions, history).previous == (1,)


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        (9, r"to a former champion \(one of 1\), got 9, which does not exist"),
        (3, "got 3, which never was champion: use `make promote`"),
        (2, "got 2, which is the champion already"),
    ],
)
def test_impossible_rollbacks_name_what_can_be_chosen(versions, history, three, wanted, said):
    promote(versions, history, three[0])
    promote(versions, history, three[1])
    with pytest.raises(ValueError, match=said):
        target(versions, stand(versions, history), wanted)


def test_a_decision_without_its_move_is_carried_out_by_whoever_comes_next(versions, history, three):
    promote(versions, history, three[0])
    # What a process leaves that is killed between the history and the alias.
    history.append("promote", 2, 1, three[1].digest, 1, "killed")
    onlooker = stand(versions, history, carry_out=False)
    assert onlooker.champion == versions.champion() == three[0]
    assert onlooker.astray.startswith("the promote of version 2 by ")
    assert onlooker.astray.endswith("was decided but not carried out: `make promote` or `make rollback` does it")
    assert stand(versions, history).champion == three[1]
    assert versions.champion() == three[1]
    assert stand(versions, history, carry_out=False).astray == ""
    assert all(e.done for e in history.events())


def test_a_decision_that_was_void_is_never_carried_out(versions, history, three):
    promote(versions, history, three[0])
    promote(versions, history, three[1])
    history.append("promote", 3, 1, three[2].digest, 1, "too late")
    assert stand(versions, history).champion == three[1]


def test_a_champion_that_was_moved_by_hand_is_reported_and_counts(versions, history, three):
    promote(versions, history, three[0])
    versions.set_champion(three[2])
    standing = stand(versions, history)
    assert standing.champion == three[2]
    assert standing.astray == (
        "the champion must be version 1 by the history, but it is version 3: it was changed by hand"
    )
    assert target(versions, standing, None).number == 1


def test_a_deleted_champion_can_be_rolled_back_and_the_story_stays(versions, history, three):
    promote(versions, history, three[0])
    promote(versions, history, three[1])
    versions.client.delete_model_version(versions.name, "2")
    standing = stand(versions, history)
    assert standing.champion is None
    assert "there is none (was the version deleted?)" in standing.astray
    version = target(versions, standing, None)
    move(versions, history, standing, "rollback", version, "deleted")
    assert versions.champion().number == 1
    assert [(e.kind, e.version, e.before) for e in history.events()] == [
        ("promote", 1, None), ("promote", 2, 1), ("rollback", 1, None),
    ]  # fmt: skip
    with pytest.raises(ValueError, match=r"got 2, which was deleted"):
        target(versions, stand(versions, history), 2)


def test_after_a_move_back_by_hand_a_rollback_does_not_go_forward(versions, history, three):
    for version in three:
        promote(versions, history, version)
    versions.set_champion(three[1])
    assert target(versions, stand(versions, history), None).number == 1


def test_a_slow_move_does_not_undo_a_newer_decision(versions, history, three, monkeypatch):
    promote(versions, history, three[0])
    standing = stand(versions, history)
    move_alias = versions.set_champion

    def slow(version):
        """While the first request hangs, somebody carries the move out and rolls it back."""
        monkeypatch.setattr(versions, "set_champion", move_alias)
        promote(versions, history, three[0], "rollback")
        move_alias(version)

    monkeypatch.setattr(versions, "set_champion", slow)
    move(versions, history, standing, "promote", three[1], "slow")
    assert versions.champion() == three[0]


def test_a_request_that_was_repeated_is_one_decision(versions, history, three, monkeypatch):
    promote(versions, history, three[0])
    create = versions.client.create_model_version

    def twice(*words, **named):
        create(*words, **named)
        return create(*words, **named)

    standing = stand(versions, history)
    monkeypatch.setattr(versions.client, "create_model_version", twice)
    event = move(versions, history, standing, "promote", three[1], "the answer was lost")
    assert event.number == 2
    assert versions.champion() == three[1]
    assert stand(versions, history).base == 2
