import pytest

from sb3_eqr.common.resets import Resets, ResetSchedule


def annealed(n_updates, n_steps=3, gamma=0.997, **schedule):
    return Resets(ResetSchedule(annealing_steps=100, **schedule)).annealed(n_updates, n_steps, gamma)


def test_n_is_annealed_geometrically():
    assert [annealed(updates, initial_n_steps=10)[0] for updates in (0, 50, 100, 900)] == [10, 5, 3, 3]  # sqrt(30) = 5.48
    assert [annealed(updates, 10, initial_n_steps=3)[0] for updates in (0, 50, 100)] == [3, 5, 10]


def test_gamma_is_annealed_geometrically_in_the_horizon():
    # 1 - γ from 0.03 to 0.003: half-way sqrt(0.03 * 0.003) = 0.00948683
    found = [annealed(updates, initial_gamma=0.97)[1] for updates in (0, 50)]
    assert found == pytest.approx([0.97, 0.99051317], rel=1e-7)
    assert annealed(100, initial_gamma=0.97)[1] == 0.997  # bit for bit


def test_without_initial_values_nothing_is_annealed():
    assert annealed(20) == (3, 0.997)


def test_when_a_reset_is_due():
    resets = Resets(ResetSchedule(interval=10))
    assert not resets.is_due(9, 90) and resets.is_due(10, 90) and resets.is_due(11, 10)
    assert not resets.is_due(11, 9)  # less than a full interval would be left
    resets.done += [10, 25]
    assert not resets.is_due(34, 90) and resets.is_due(35, 90)
    assert not Resets(ResetSchedule()).is_due(10**9, 90)


def test_after_a_reset_annealing_starts_again():
    resets = Resets(ResetSchedule(initial_n_steps=10, annealing_steps=100))
    resets.done.append(500)
    assert [resets.annealed(updates, 3, 0.9)[0] for updates in (500, 550, 600)] == [10, 5, 3]


def test_a_schedule_from_a_dictionary():
    assert ResetSchedule.of(None) == ResetSchedule() == ResetSchedule.of({})
    assert ResetSchedule.of({"interval": 5, "shrink_factor": 1}) == ResetSchedule(interval=5, shrink_factor=1)
    with pytest.raises(TypeError, match=r"resets got an unexpected argument 'intervall'. Did you mean 'interval'\?"):
        ResetSchedule.of({"intervall": 5})
    with pytest.raises(TypeError, match="resets must be a ResetSchedule, a dict of its fields or None, got 40000"):
        ResetSchedule.of(40_000)
