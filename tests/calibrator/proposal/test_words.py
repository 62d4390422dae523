import pytest

from calibrator.words import is_battery, places_of, words_of


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("SmoothBattCurrent132", "smooth batt current 132"),
        ("ID266RearInverterPower", "id 266 rear inverter power"),
        ("HV_BatteryVoltage", "hv battery voltage"),
        ("PTC_leftCurrentHV", "ptc left current hv"),
        ("DcDc_LowVoltagePower", "dcdc lv power"),
        ("AirConPowerDemand", "aircon power demand"),
    ],
)
def test_names_are_split_into_words(text: str, words: str) -> None:
    assert " ".join(words_of(text)) == words


def test_places_are_known_by_the_words_of_several_houses() -> None:
    assert places_of(words_of("BMS_PackCurrent")) == {"battery"}
    assert places_of(words_of("INV_DcPower")) == {"motor"}
    assert places_of(words_of("Odometer")) == set()
    assert places_of(words_of("PWR_LeistDC", "DC-Leistung Pulswechselrichter")) == {"motor"}
    assert places_of(words_of("LadegStrom", "HV-Ladegerät")) == {"charger"}
    assert words_of("Längsbeschleunigung") == ("laengsbeschleunigung",)
    assert places_of(words_of("BAT_StromIst", "HV-Batteriestrom am Shunt")) == {"battery"}


def test_a_battery_is_known_by_the_branch_or_else_by_its_signal() -> None:
    assert is_battery("battery", "X.Y")
    assert is_battery("source", "BMS_1.PackCurrent")
    assert not is_battery("motor", "BMS_1.InverterCurrent")
