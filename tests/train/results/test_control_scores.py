import json

from probe_kit.train import ControlComparison, Controls, ControlScore, UntrainedScore
from probe_kit.train.results.control_scores import has_signal


def score_of(name: str, p: float | None = 0.5, score: float = 0.5) -> ControlScore:
    return ControlScore(name, "color", score, (0.4, 0.6), p, 0.5, 80)


def untrained(site: str, peak: bool) -> UntrainedScore:
    return UntrainedScore("color", "mean", site, site, peak, 0.9, 0.5, 0.4, (0.3, 0.5), "tiny (random weights)")


def test_above_chance_means_a_small_p() -> None:
    assert score_of("pixels", 0.01).above_chance
    assert not score_of("pixels", 0.05).above_chance
    assert not score_of("pixels", None).above_chance


def test_a_newer_score_replaces_an_older_one_and_keeps_the_untrained_network() -> None:
    controls = Controls((score_of("pixels"), score_of("position")), (untrained("backbone.01.residual", True),))
    merged = controls.with_scores([score_of("pixels", score=0.9)])
    assert {name: score.score for name, score in merged.of_category("color").items()} == {
        "pixels": 0.9,
        "position": 0.5,
    }
    assert merged.untrained == controls.untrained
    assert merged.of_category("shape") == {}


def test_the_untrained_network_of_a_stream_is_its_peak() -> None:
    scores = [
        untrained("backbone.01.residual", False),
        untrained("expert.00.residual@1", True),
        untrained("backbone.03.residual", True),
    ]
    controls = Controls().with_untrained(scores)
    assert controls.untrained_peak("color", "mean", "backbone") == scores[2]
    assert controls.untrained_peak("color", "last", "backbone") is None


def test_a_signal_must_exceed_every_control_that_was_run() -> None:
    site = "backbone.01.residual"
    controls = Controls().with_scores([], [ControlComparison("random-features", "color", "mean", site, 0.6, 0.2)])
    assert controls.exceeds("color", "mean", site, 0.001) == {
        "chance": True,
        "random-features": False,
        "untrained": None,
    }
    assert not has_signal(controls.exceeds("color", "mean", site, 0.001))
    better = controls.with_scores([], [ControlComparison("random-features", "color", "mean", site, 0.6, 0.01)])
    assert has_signal(better.exceeds("color", "mean", site, 0.001))
    assert not has_signal(better.exceeds("color", "mean", site, 0.2))
    assert better.exceeds("shape", "mean", site, 0.001) == {
        "chance": True,
        "random-features": None,
        "untrained": None,
    }
    assert has_signal({"chance": True, "random-features": None, "untrained": None})
    assert better.exceeds("color", "mean", site, float("nan"))["chance"] is None
    assert not has_signal(better.exceeds("color", "mean", site, float("nan")))


def test_json_gives_the_same_controls_back() -> None:
    excess = ControlComparison("untrained", "color", "mean", "backbone.01.residual", 0.6, 0.2)
    controls = Controls((score_of("pixels", None),), (untrained("backbone.01.residual", True),), (excess,))
    assert Controls.from_json(json.loads(json.dumps(controls.to_json()))) == controls
