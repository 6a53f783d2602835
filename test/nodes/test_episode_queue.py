"""Values that states ask for, episode by episode."""

from endo_sim_ros.nodes.episode_queue import EpisodeQueue


def filled(*items):
    queue = EpisodeQueue()
    for stamp, value in items:
        queue.put(stamp, value)
    return queue


def taken(queue, stamps):
    """What states with these stamps find, in order."""
    found = []
    for i, stamp in enumerate(stamps):
        found.append(queue.find(stamp, stamps[i + 1 :]))
        queue.forget(stamp)
    return found


def test_episodes_that_all_came_before_the_first_state_are_told_apart():
    queue = filled((0, "a"), (0, "b"), (1, "c"), (2, "d"), (0, "e"), (1, "f"), (2, "g"))
    assert taken(queue, [0, 0, 1, 2, 0, 1, 2]) == list("abcdefg")


def test_what_is_missing_in_one_episode_is_not_taken_from_the_next():
    queue = filled((1, "a"), (3, "c"), (1, "d"), (2, "e"), (3, "f"))
    assert queue.find(2, [3]) is None and queue.passed([3])
    assert taken(queue, [1, 2, 3, 1, 2, 3]) == ["a", None, "c", "d", "e", "f"]


def test_what_no_state_wanted_is_dropped_when_the_next_episode_begins():
    queue = filled((8, "a"), (9, "b"), (1, "c"), (2, "d"))
    assert taken(queue, [1, 2]) == ["c", "d"]
    assert queue.newest is None


def test_a_value_may_be_sent_again():
    queue = EpisodeQueue()
    for value in "ab":
        queue.put(1, value, replace=True)
    assert queue.find(1, []) == "b" and not queue.passed([2])
