"""What a wrong name is answered with."""

from __future__ import annotations

from ugat_marl.errors import LISTED, UnknownNameError


def test_a_short_list_is_whole_and_names_with_commas_are_told_apart() -> None:
    said = str(UnknownNameError("row", "timd", ["UGAT, timed", "UGAT"]))
    assert said == "unknown row 'timd'. Did you mean 'UGAT, timed'? Known: UGAT, 'UGAT, timed'."


def test_of_a_long_list_the_nearest_are_shown_and_the_rest_counted() -> None:
    names = [f"effect_{number}" for number in range(LISTED)] + ["delay", "delays"]
    error = UnknownNameError("effect", "dely", names, "See the page.")
    said = str(error)
    assert said.startswith("unknown effect 'dely'. Did you mean 'delay'? Known: delay, delays, ")
    assert said.endswith("and 2 more. See the page.")
    assert error.allowed == sorted(names)


def test_the_only_name_that_begins_so_is_meant() -> None:
    names = ["observation", "reward", "neighbours"]
    assert "Did you mean 'observation'?" in str(UnknownNameError("option", "obs", names))
    assert "Did you mean" not in str(UnknownNameError("option", "ob", names))


def test_what_is_only_a_little_alike_is_not_meant() -> None:
    for name, known in (("learning", ["flag", "lr"]), ("nope", ["EnvOpt"])):
        assert "Did you mean" not in str(UnknownNameError("setting", name, known))
    assert "Did you mean 'V1'?" in str(UnknownNameError("domain", "V5", ["V1", "noise-5"]))


def test_where_nothing_is_known_nothing_is_listed() -> None:
    assert str(UnknownNameError("learner in math", "x", [])) == "unknown learner in math 'x'."
