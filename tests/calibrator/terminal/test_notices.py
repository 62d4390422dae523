"""Equal notices of many drives are told once."""

from calibrator.terminal.text import Notice, left_out_text, merged_notices, reasons_text, told_once


def spoilt(bad: int, of: int) -> Notice:
    return Notice(text="temperature: {} of {} frames not usable", counts=(bad, of))


def test_one_notice_of_many_vehicles_is_one_line_with_the_sum_of_its_counts() -> None:
    notices = {(f"V{k:03}", "drive"): [spoilt(k, 10 * k)] for k in range(1, 45)}
    assert merged_notices(notices) == ["in 44 vehicles: temperature: 990 of 9900 frames not usable"]


def test_where_a_notice_holds_is_said_exactly() -> None:
    one = {("V1", "monday"): [spoilt(1, 2)]}
    assert merged_notices(one) == ["V1/monday: temperature: 1 of 2 frames not usable"]
    same_vehicle = one | {("V1", "tuesday"): [spoilt(2, 2)]}
    assert merged_notices(same_vehicle) == ["in 2 drives of V1: temperature: 3 of 4 frames not usable"]
    three = same_vehicle | {("V2", "monday"): [spoilt(1, 2)]}
    assert merged_notices(three) == ["in 3 drives of 2 vehicles: temperature: 4 of 6 frames not usable"]


def test_one_reason_of_many_vehicles_is_one_line() -> None:
    names = [f"V{k:03}" for k in range(1, 45)]
    line = "V001, V002, V003, V004, V005, V006 and 38 more: too short"
    assert told_once((name, "too short") for name in names) == [line]
    assert left_out_text(dict.fromkeys(names, "too short")) == f"left out:\n  {line}"
    assert reasons_text("cannot tell", dict.fromkeys(names, "too short")) == f"cannot tell:\n  {line}"


def test_nothing_to_tell_is_no_text() -> None:
    assert (left_out_text({}), reasons_text("cannot tell", {})) == ("", "")
