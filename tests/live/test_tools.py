"""Tools in the loop: what they give reaches the fit and the sinks; their trouble costs no frame."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from live_objects import (
    STAMP_NS,
    small_anatomy,
    small_estimate,
    small_frame,
    small_setting,
    small_update,
)
from refused import refused
from reports import reporting
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.evidence import Outline, Touch
from tumortrack.core.report import EvidenceReport
from tumortrack.core.types import SensorCloud
from tumortrack.live.session import named_tools
from tumortrack.live.tools import Tool, ToolConfig, Tools
from tumortrack.live.values import CameraView, Observation
from tumortrack.live.views import ViewsLocator
from tumortrack.segmentation import RegionConfig
from tumortrack.tracking.follower import Follower

SETTING = replace(small_setting(), anatomy_ct=small_anatomy())
ONE, TWO = (Touch(place_mm=(0.0, y, 120.0), tool="probe") for y in (1.0, 2.0))


def view(**more):
    return CameraView(1, Observation(small_frame(), STAMP_NS, **more), np.eye(4))


class Scripted(Tool):
    """Gives what it is told to."""

    def __init__(self, *script):
        super().__init__()
        self.script, self.seen, self.clicks, self.closed = list(script), [], 0, 0

    def evidence(self, view):
        act = self.script.pop(0) if len(self.script) > 1 else self.script[0]
        return act() if callable(act) else act

    def located(self, view, estimate):
        self.seen.append(estimate)

    def touched(self):
        self.clicks += 1

    def close(self):
        self.closed += 1


class Scripts(ToolConfig, frozen=True, kw_only=True, tag="scripted"):
    made: object

    def open(self, context, name):
        if isinstance(self.made, Exception):
            raise self.made
        return self.made


def tools(setting=SETTING, **made):
    notes = []
    return Tools({name: Scripts(made=one) for name, one in made.items()}, setting, notes), notes


def broken():
    raise ZeroDivisionError("of the driver")


def test_a_broken_tool_is_named_once_and_the_others_are_heard():
    probe = Scripted((ONE,), (TWO,))
    all_tools, notes = tools(bad=Scripted(broken), probe=probe)
    assert [all_tools.evidence(view()) for _ in range(3)] == [(ONE,), (TWO,), (TWO,)]
    assert notes == ["tool bad: ZeroDivisionError: of the driver"]
    probe.located = lambda *_: broken()
    all_tools.located(view(), small_estimate())
    assert notes[1:] == ["tool probe: ZeroDivisionError: of the driver"]
    assert all_tools.summary()["bad"]["trouble"] == ["ZeroDivisionError: of the driver"]
    all_tools.close()
    assert probe.closed == 1


def test_what_does_not_fit_the_organ_is_dropped_and_the_rest_goes_on():
    strange = Outline(part="spleen", places_mm=((0.0, 0.0, 120.0),))
    all_tools, notes = tools(probe=Scripted((ONE,)))
    assert all_tools.evidence(view(evidence=(strange, TWO))) == (TWO, ONE)
    assert "spleen" in notes[0]
    without_motion, notes = tools(small_setting())
    assert without_motion.evidence(view(evidence=(ONE,))) == ()
    assert len(notes) == 1


def test_a_tool_that_can_never_work_refuses_the_run_and_closes_the_others():
    probe = Scripted((ONE,))
    with refused(InputError, "arm"):
        tools(probe=probe, arm=InputError("it is off"))
    assert probe.closed == 1
    with refused(InputError, "probe"):
        tools(small_setting(), probe=probe)


def test_clicks_reach_the_tool_of_that_name_and_what_was_left_out_is_counted():
    probe = Scripted((ONE, TWO))
    all_tools, _ = tools(probe=probe)
    SETTING.controls.touched.extend(["probe", "nobody", "probe"])
    all_tools.evidence(view())
    assert probe.clicks == 2
    assert not SETTING.controls.touched
    said = [
        EvidenceReport(name="touch", off_mm=off_mm, information_gain=0.5, rejected=off_mm > 9)
        for off_mm in (30.0, 0.1, 20.0)  # the first is of an earlier frame
    ]
    estimate = reporting(small_estimate(), evidence=tuple(said))
    all_tools.located(view(), estimate)
    assert probe.seen == [estimate]
    assert all_tools.summary()["probe"]["rejected"] == 1
    update = replace(small_update(), estimate=estimate)
    assert re.findall(r"\d+", update.describe().split(";")[-1]) == ["1", "2"]  # used, left out


class Following(Follower):
    """A follower that keeps what it is given."""

    def __init__(self):
        self.given, self.fails = [], False

    def last_box_mm(self, *_):
        return None

    def locate(self, cloud, seen, *, views, evidence, camera_from_last):
        self.given.append(evidence)
        if self.fails:
            raise NoEstimate("hidden")
        return small_estimate()


def test_evidence_of_tools_and_source_reaches_the_fit_in_the_frame_it_came_with():
    follower = Following()
    views = ViewsLocator(follower, SETTING, RegionConfig(), 0.0, 0)
    views.tools, _ = tools(probe=Scripted((ONE,), ()))
    organ = SensorCloud(small_anatomy().organ.vertices_mm, STAMP_NS)
    views.locate([(view(evidence=(TWO,)), organ)])
    assert follower.given == [(TWO, ONE)] == [views.evidence]
    follower.fails = True
    with pytest.raises(NoEstimate):
        views.locate([(view(), organ)])
    assert follower.given[1] == () == views.evidence


@pytest.mark.parametrize("text", ["probe", "=file:a.csv", "a b=file:a.csv", "9=file:a.csv"])
def test_a_tool_has_a_name_and_a_kind(text):
    with pytest.raises(InputError):
        named_tools([text])
