"""What needles may differ by is asked once each: when the fit has converged, or at the latest after some rounds."""

from __future__ import annotations

from rsa_vision.detect.needles.questions import OF_ARMS, OF_BLURS, OF_DENSITIES, OF_TAPERS, Agenda


def asked(agenda: Agenda, rounds: int, answers: frozenset[str] = frozenset(), converged_after: int = 99) -> list[tuple[int, str]]:
    """Return what is asked in each round; what has an answer ends its round, and the fit is converged no more for three rounds."""
    told = []
    for count in range(rounds):
        for question in agenda.due(count, count >= converged_after, count >= 2):
            told.append((count, question))
            if question in answers:
                converged_after = count + 3
                break
    return told


def test_everything_is_asked_at_once_where_it_converges() -> None:
    assert asked(Agenda.of(alike=True), 9, converged_after=2) == [(2, OF_BLURS), (2, OF_TAPERS), (2, OF_DENSITIES), (2, OF_ARMS)]


def test_everything_is_asked_at_the_latest() -> None:
    late = [(3, OF_BLURS), (4, OF_ARMS), (5, OF_TAPERS), (9, OF_DENSITIES)]
    assert asked(Agenda.of(alike=True), 20) == late
    assert asked(Agenda.of(alike=False), 20) == late[:2]


def test_an_answer_ends_its_round() -> None:
    first = [(2, OF_BLURS), (4, OF_ARMS), (5, OF_TAPERS), (5, OF_DENSITIES)]
    assert asked(Agenda.of(alike=True), 20, frozenset([OF_BLURS]), converged_after=2) == first
    assert asked(Agenda.of(alike=True), 20, frozenset([OF_TAPERS]), converged_after=2)[-1] == (5, OF_DENSITIES)


def test_sizes_must_be_known_for_tapers() -> None:
    agenda = Agenda.of(alike=True)
    assert list(agenda.due(1, True, False)) == [OF_BLURS, OF_ARMS]
    assert list(agenda.due(2, True, True)) == [OF_TAPERS, OF_DENSITIES]
