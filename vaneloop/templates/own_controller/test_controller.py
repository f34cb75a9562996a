"""Tests of the controller in pytest: ``make && pytest --vaneloop-controller ./my_controller.so``."""


def test_a_short_silence_of_the_ecu_is_ridden_through(sil):
    outcome = sil.run(sil.Drop(start=2.0, duration=0.03), duration=4.0)
    assert outcome.mode_at(3.9) == "RUN"


def test_a_long_silence_ends_in_fail_safe(sil):
    outcome = sil.run(sil.Drop(start=2.0, duration=2.0), duration=7.0)
    assert outcome.mode_at(3.9) == "FAIL_SAFE" and outcome.mode == "RUN"
