"""What the study measures: every number that decides a figure, and the jobs that follow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from tumortrack.core.config import Config
from tumortrack_lab.study.bound import BOUNDS
from tumortrack_lab.study.measure import Job, StudyCase, by_method
from tumortrack_lab.study.methods import Method, Network
from tumortrack_lab.study.models import CLINIC, UNREFINED, configuration_name
from tumortrack_lab.study.resection import Cutting, Truth

VARIANTS = ("D0", "D1", "D2", "D3", "Rot90", "Rot180", "Rot270", "G1", "P1")
VIEWS = ("clean", "noise", "shaft", "clutter")
FAULTS = (
    "clean", "noise", "distortion", "offset", "occlusion", "outliers", "registration", "all"
)  # fmt: skip
SEVERITIES = (
    "noise=0.5", "noise=1", "noise=2", "noise=4",
    "visible=80", "visible=60", "visible=40",
    "outliers=1", "outliers=3", "outliers=10", "outliers=20",
    "points=500", "points=1000", "points=2000",
    "offset=1", "offset=2", "offset=4",
    "distance=80", "distance=120", "distance=160", "distance=200", "distance=250", "distance=300",
    "tilt=15", "tilt=30", "tilt=45",
)  # fmt: skip
HIDDEN = "visible=60"  # the severity of the goals: 40 % of the visible surface is hidden
ABLATION = (
    CLINIC, f"{CLINIC}{UNREFINED}", "clinic_clean", "clinic_drags", "clinic_pointnet",
    "quick_elastic", "M_lim",
)  # fmt: skip
Section = Literal[
    "accuracy", "goals", "ablation", "deformation", "peers", "faults", "views", "severity",
    "resection",
]  # fmt: skip
SECTIONS: tuple[Section, ...] = get_args(Section)


class StudyPlan(Config, frozen=True):
    """Which cells there are.

    ``accuracy`` (the paper's table of results) is measured at ``grid``, everything else at
    ``coarse_grid``. ``seeds`` are those of networks for the paper's phantom; other cases and the
    deformation study may do with fewer, a coarser grid and fewer peers (None: the same). Faults,
    views and severities are measured on the paper's phantom alone, with the first seed;
    severities beside the clean scene, which is the end of most curves. ``steps`` are those of
    M_lim and M_full, ``clinic_steps`` those of the preset ``clinic``; models of the ablation have
    all seen ``ablation_scenes``, whatever their batches.
    """

    name: str
    models: tuple[str, ...] = ("M_lim", "M_full", CLINIC)
    steps: int = 12_000
    clinic_steps: int = 6_000
    configuration_steps: int = 12_000
    seeds: tuple[int, ...] = (0, 1, 2)
    case_seeds: tuple[int, ...] | None = None
    configuration_seeds: tuple[int, ...] | None = None
    variants: tuple[str, ...] = VARIANTS
    view: str = "noise"  # of every table but those of faults and views
    grid: int = 400
    case_grid: int | None = None
    coarse_grid: int = 160
    configurations: tuple[int, ...] = (1, 2, 3, 4, 5, 6)
    configuration_variants: tuple[str, ...] = ("D0", "D1", "D2", "D3")
    configuration_view: str = "noise"
    peers: tuple[str, ...] = ("rigid_bound", "rigid", "cpd", "elastic")
    case_peers: tuple[str, ...] | None = None
    faults: tuple[str, ...] = FAULTS
    fault_seeds: tuple[int, ...] = (0, 1, 2)  # a shaft or a direction is drawn anew for each
    fault_models: tuple[str, ...] = ("M_lim", CLINIC)
    fault_peers: tuple[str, ...] = ("elastic",)
    fault_variants: tuple[str, ...] = ("D1", "D2", "D3", "G1", "P1")
    views: tuple[str, ...] = VIEWS
    severities: tuple[str, ...] = SEVERITIES
    severity_seeds: tuple[int, ...] = (0, 1, 2)
    severity_variants: tuple[str, ...] = ("D2", "G1")
    severity_models: tuple[str, ...] = ("M_lim", CLINIC)
    severity_peers: tuple[str, ...] = ("rigid",)
    goal_models: tuple[str, ...] = ("M_lim", CLINIC)
    goal_peers: tuple[str, ...] = ("elastic",)
    resection_models: tuple[str, ...] = ("M_lim", CLINIC)
    ablation_models: tuple[str, ...] = ABLATION
    ablation_cases: tuple[str, ...] = ("phantom", "case_00000")  # of those that are given
    ablation_scenes: int = 32_000
    ablation_seeds: tuple[int, ...] = (0, 1, 2)
    ablation_views: tuple[str, ...] = ("noise", "shaft")
    ablation_variants: tuple[str, ...] = ("D1", "D2", "D3", "G1", "P1")

    def seeds_for(self, case: StudyCase) -> tuple[int, ...]:
        return self.seeds if case.is_paper or self.case_seeds is None else self.case_seeds

    def peers_for(self, case: StudyCase) -> tuple[str, ...]:
        return self.peers if case.is_paper or self.case_peers is None else self.case_peers

    def grid_for(self, case: StudyCase) -> int:
        return self.grid if case.is_paper or self.case_grid is None else self.case_grid


FULL = StudyPlan(name="full")
QUICK = StudyPlan(
    name="quick",
    steps=800,
    clinic_steps=200,
    configuration_steps=800,
    seeds=(0,),
    variants=("D0", "D2", "G1"),
    grid=96,
    coarse_grid=96,
    configurations=(1, 3),
    configuration_variants=("D1", "D3"),
    peers=("rigid_bound", "rigid", "elastic"),
    faults=("clean", "noise", "offset", "all"),
    fault_seeds=(0,),
    fault_variants=("D2", "G1"),
    views=("clean", "noise", "clutter"),
    severities=("noise=2", "visible=60", "points=500", "tilt=30"),
    severity_seeds=(0,),
    ablation_models=(CLINIC, f"{CLINIC}{UNREFINED}", "quick_elastic"),
    ablation_scenes=3_200,
    ablation_seeds=(0,),
    ablation_variants=("D2", "G1"),
)

Peers = Callable[[str, StudyCase], Method]
Models = Callable[[StudyCase, str, int], Network]


@dataclass(frozen=True)
class Methods:
    """Where methods come from: trained models, those of the ablation, peers (and bounds) made
    ready for a patient."""

    model: Models
    peer: Peers
    ablated: Models


def jobs_of(
    plan: StudyPlan,
    section: Section,
    cases: tuple[StudyCase, ...],
    methods: Methods,
) -> list[Job]:
    """The jobs of one section, grouped by method. Models that are not trained yet are trained.

    ``cases``: for ``deformation`` the second phantom, for all others every case.
    """
    makers = {
        "accuracy": _accuracy,
        "goals": _goals,
        "ablation": _ablation,
        "deformation": _deformation,
        "peers": _peers,
        "faults": _faults,
        "views": _views,
        "severity": _severity,
        "resection": _resection,
    }
    jobs = [job for case in cases for job in makers[section](plan, case, methods)]
    return by_method(jobs)


def scenes_of(plan: StudyPlan, section: Section) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Variants and views that a section needs; the clean view always, for it says what is
    visible."""
    variants = {
        "ablation": plan.ablation_variants,
        "deformation": plan.configuration_variants,
        "faults": plan.fault_variants,
        "severity": plan.severity_variants,
    }
    views = {
        "ablation": plan.ablation_views,
        "deformation": (plan.configuration_view,),
        "faults": (),
        "views": plan.views,
        "severity": (),
    }.get(section, (plan.view,))
    return variants.get(section, plan.variants), tuple(dict.fromkeys(("clean", *views)))


def _accuracy(plan: StudyPlan, case: StudyCase, methods: Methods) -> list[Job]:
    return [
        Job(case, model, variant, plan.view, plan.grid_for(case))
        for model in _networks(plan, case, methods)
        for variant in plan.variants
    ]


def _deformation(plan: StudyPlan, case: StudyCase, methods: Methods) -> list[Job]:
    seeds = plan.seeds if plan.configuration_seeds is None else plan.configuration_seeds
    return [
        Job(case, model, variant, plan.configuration_view, plan.coarse_grid)
        for number in plan.configurations
        for seed in seeds
        for model in [methods.model(case, configuration_name(number), seed)]
        for variant in plan.configuration_variants
    ]


def _peers(plan: StudyPlan, case: StudyCase, methods: Methods) -> list[Job]:
    beside = [methods.peer(name, case) for name in plan.peers_for(case)]
    return [
        Job(case, method, variant, plan.view, plan.coarse_grid)
        for method in [*_networks(plan, case, methods), *beside]
        for variant in plan.variants
    ]


def _faults(plan: StudyPlan, case: StudyCase, methods: Methods) -> list[Job]:
    beside = [methods.peer(name, case) for name in plan.fault_peers if name in plan.peers]
    return [
        Job(case, method, variant, "clean", plan.coarse_grid, fault, seed)
        for method in [*_first_seed(plan, case, methods, plan.fault_models), *beside]
        for fault in plan.faults
        for seed in (plan.fault_seeds if fault != "clean" else (0,))
        for variant in plan.fault_variants
    ]


def _views(plan: StudyPlan, case: StudyCase, methods: Methods) -> list[Job]:
    return [
        Job(case, method, variant, view, plan.coarse_grid)
        for method in _first_seed(plan, case, methods, plan.models)
        for view in plan.views
        for variant in plan.variants
    ]


def _severity(plan: StudyPlan, case: StudyCase, methods: Methods) -> list[Job]:
    beside = [methods.peer(name, case) for name in plan.severity_peers if name in plan.peers]
    draws = [(name, draw) for name in plan.severities for draw in plan.severity_seeds]
    return _disturbed(
        plan, case, [*_first_seed(plan, case, methods, plan.severity_models), *beside], draws
    )


def _goals(plan: StudyPlan, case: StudyCase, methods: Methods) -> list[Job]:
    """Everything on the noisy scenes; methods that have to find the organ also where a part of
    the visible surface is hidden, for the bounds do not look at the cloud."""
    seeds = plan.seeds_for(case)
    models = [methods.model(case, name, seed) for name in plan.goal_models for seed in seeds]
    beside = [methods.peer(name, case) for name in plan.goal_peers]
    bounds = [methods.peer(name, case) for name in BOUNDS]
    draws = [(HIDDEN, draw) for draw in plan.severity_seeds]
    return [
        Job(case, method, variant, plan.view, plan.coarse_grid)
        for method in [*models, *beside, *bounds]
        for variant in plan.variants
    ] + _disturbed(plan, case, [*models, *beside], draws)


def _resection(plan: StudyPlan, case: StudyCase, methods: Methods) -> list[Job]:
    located_by = [*_first_seed(plan, case, methods, plan.resection_models), Truth()]
    return [
        Job(case, cutting, variant, plan.view, plan.coarse_grid)
        for cutting in map(Cutting, located_by)
        for variant in plan.variants
    ]


def _ablation(plan: StudyPlan, case: StudyCase, methods: Methods) -> list[Job]:
    if case.name not in plan.ablation_cases:
        return []
    return [
        Job(case, model, variant, view, plan.coarse_grid)
        for name in plan.ablation_models
        for seed in plan.ablation_seeds
        for model in [methods.ablated(case, name, seed)]
        for view in plan.ablation_views
        for variant in plan.ablation_variants
    ]


def _disturbed(
    plan: StudyPlan, case: StudyCase, methods: Sequence[Method], draws: list[tuple[str, int]]
) -> list[Job]:
    return [
        Job(case, method, variant, "clean", plan.coarse_grid, fault, draw)
        for method in methods
        for fault, draw in [("clean", 0), *draws]
        for variant in plan.severity_variants
    ]


def _first_seed(
    plan: StudyPlan, case: StudyCase, methods: Methods, models: tuple[str, ...]
) -> list[Network]:
    return [methods.model(case, name, plan.seeds_for(case)[0]) for name in models]


def _networks(plan: StudyPlan, case: StudyCase, methods: Methods) -> list[Network]:
    return [
        methods.model(case, name, seed) for name in plan.models for seed in plan.seeds_for(case)
    ]
