"""What the study measures: every number that decides a figure, and the jobs that follow."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal, get_args

from tumortrack.core.config import Config
from tumortrack_lab.study.bound import BOUNDS
from tumortrack_lab.study.cases import StudyCase
from tumortrack_lab.study.measure import CLEAN_VIEW, Job, by_method
from tumortrack_lab.study.methods import Method, Network
from tumortrack_lab.study.models import CLINIC, UNREFINED
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
_HIDDEN = "visible=60"  # the severity of the goals: 40 % of the visible surface is hidden
_ABLATION = (
    CLINIC, f"{CLINIC}{UNREFINED}", "clinic_clean", "clinic_drags", "clinic_pointnet",
    "quick_elastic", "M_lim",
)  # fmt: skip
Section = Literal[
    "accuracy", "goals", "ablation", "deformation", "peers", "faults", "views", "severity",
    "resection",
]  # fmt: skip
SECTIONS: tuple[Section, ...] = get_args(Section)
Draws = tuple[tuple[str, int], ...]  # faults, and the seeds of their random part


class StudyPlan(Config, frozen=True):
    """What is measured. Severities are measured beside the clean scene, which is the end of most
    curves. None: the same as the phantom's."""

    name: str
    # In accuracy, peers and views: M_lim, M_full, clinic
    models: tuple[str, ...] = ("M_lim", "M_full", CLINIC)
    steps: int = 12_000  # Of training M_lim and M_full
    clinic_steps: int = 6_000  # Of training clinic (the preset's)
    # Of training in the deformation study (as many as --steps)
    configuration_steps: int | None = None
    seeds: tuple[int, ...] = (0, 1, 2)  # Of training
    case_seeds: tuple[int, ...] | None = None  # Of training for --case (the same as the phantom's)
    # Of training in the deformation study (the same as the phantom's)
    configuration_seeds: tuple[int, ...] | None = None
    variants: tuple[str, ...] = VARIANTS  # Of every table that names no others
    view: str = "noise"  # Of every table but those of faults and views
    grid: int = 400  # Voxels along the longest side, in the table of accuracy
    case_grid: int | None = None  # The same for --case (as for the phantom)
    coarse_grid: int = 160  # The same in every other table
    configurations: tuple[int, ...] = (1, 2, 3, 4, 5, 6)  # Rows of the paper's deformation table
    configuration_variants: tuple[str, ...] = ("D0", "D1", "D2", "D3")  # In the deformation study
    configuration_view: str = "noise"  # In the deformation study
    peers: tuple[str, ...] = ("rigid_bound", "rigid", "cpd", "elastic")  # Methods beside the models
    case_peers: tuple[str, ...] | None = None  # Peers for --case (as for the phantom)
    faults: tuple[str, ...] = FAULTS  # Error sources
    fault_seeds: tuple[int, ...] = (0, 1, 2)  # Of the random part of each fault
    fault_models: tuple[str, ...] = ("M_lim", CLINIC)  # Models in the table of faults
    fault_peers: tuple[str, ...] = ("elastic",)  # Peers in the table of faults
    fault_variants: tuple[str, ...] = ("D1", "D2", "D3", "G1", "P1")  # In the table of faults
    views: tuple[str, ...] = VIEWS  # In the table of views
    # Faults and their levels, such as visible=60 (those of the plan)
    severities: tuple[str, ...] = SEVERITIES
    severity_seeds: tuple[int, ...] = (0, 1, 2)  # Of the random part of each severity
    severity_variants: tuple[str, ...] = ("D2", "G1")  # In the severities
    severity_models: tuple[str, ...] = ("M_lim", CLINIC)  # Models beside the severities' peers
    severity_peers: tuple[str, ...] = ("rigid",)  # Peers in the severities
    goal_models: tuple[str, ...] = ("M_lim", CLINIC)  # Models in the table of goals
    goal_peers: tuple[str, ...] = ("elastic",)  # Peers in the table of goals
    # Models whose estimates are planned on and cut, beside the truth
    resection_models: tuple[str, ...] = ("M_lim", CLINIC)
    ablation_models: tuple[str, ...] = _ABLATION  # Rows of the ablation
    # Cases of the ablation, of those that are given
    ablation_cases: tuple[str, ...] = ("phantom", "case_00000")
    # Training scenes of each model in the ablation, whatever its batches
    ablation_scenes: int = 32_000
    ablation_seeds: tuple[int, ...] = (0, 1, 2)  # Of training in the ablation
    ablation_views: tuple[str, ...] = ("noise", "shaft")  # Views in the ablation
    ablation_variants: tuple[str, ...] = ("D1", "D2", "D3", "G1", "P1")  # In the ablation


FULL = StudyPlan(name="full")
QUICK = StudyPlan(
    name="quick",
    steps=800,
    clinic_steps=200,
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


@dataclass(frozen=True)
class _Block:
    """Every method on every scene under every fault. The methods come last: making them trains."""

    methods: Callable[[Methods], Iterable[Method]]
    variants: tuple[str, ...]
    views: tuple[str, ...]
    grid: int
    faults: Draws = (("none", 0),)

    def jobs(self, case: StudyCase, methods: Methods) -> Iterator[Job]:
        made = list(self.methods(methods))
        for method, view, fault, variant in product(made, self.views, self.faults, self.variants):
            yield Job(case, method, variant, view, self.grid, *fault)


def jobs_of(
    plan: StudyPlan, section: Section, cases: tuple[StudyCase, ...], methods: Methods
) -> list[Job]:
    """The jobs of one section, grouped by method. Models that are not trained yet are trained.

    ``cases``: for ``deformation`` the second phantom; for faults, views and severities, which have
    the first seed alone, the paper's phantom; for all others every case.
    """
    return by_method(
        job
        for case in cases
        for block in _blocks(plan, section, case)
        for job in block.jobs(case, methods)
    )


def scenes_of(
    plan: StudyPlan, section: Section, case: StudyCase
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Variants and views that a section needs; the clean view always, for it says what is
    visible."""
    blocks = _blocks(plan, section, case)
    variants = (variant for block in blocks for variant in block.variants)
    views = (view for block in blocks for view in block.views)
    return tuple(dict.fromkeys(variants)), tuple(dict.fromkeys((CLEAN_VIEW, *views)))


def _blocks(plan: StudyPlan, section: Section, case: StudyCase) -> list[_Block]:
    def other(ours: tuple, theirs: tuple | None) -> tuple:
        return ours if case.is_paper or theirs is None else theirs

    seeds = other(plan.seeds, plan.case_seeds)
    grid, views = plan.coarse_grid, (plan.view,)

    def made(
        models: Sequence[str], peers: Sequence[str] = (), seeds: Sequence[int] = seeds
    ) -> Callable[[Methods], Iterable[Method]]:
        return lambda methods: [
            *(methods.model(case, name, seed) for name in models for seed in seeds),
            *(methods.peer(name, case) for name in peers),
        ]

    def one_seed(
        models: Sequence[str], peers: Sequence[str] = ()
    ) -> Callable[[Methods], Iterable[Method]]:
        return made(models, [name for name in peers if name in plan.peers], seeds[:1])

    def disturbed(
        methods: Callable[[Methods], Iterable[Method]], severities: Sequence[str]
    ) -> _Block:
        draws = (("clean", 0), *product(severities, plan.severity_seeds))
        return _Block(methods, plan.severity_variants, (CLEAN_VIEW,), grid, draws)

    if section == "accuracy":
        coarser = None if case.is_paper else plan.case_grid
        return [_Block(made(plan.models), plan.variants, views, coarser or plan.grid)]
    if section == "goals":
        # Hidden surface is for methods that have to find the organ: bounds do not see the cloud.
        finding = made(plan.goal_models, plan.goal_peers)
        everything = made(plan.goal_models, (*plan.goal_peers, *BOUNDS))
        return [_Block(everything, plan.variants, views, grid), disturbed(finding, (_HIDDEN,))]
    if section == "ablation":
        return [
            _Block(
                lambda methods: (
                    methods.ablated(case, name, seed)
                    for name, seed in product(plan.ablation_models, plan.ablation_seeds)
                ),
                plan.ablation_variants,
                plan.ablation_views,
                grid,
            )
        ] * (case.name in plan.ablation_cases)
    if section == "deformation":
        names = [f"configuration_{number}" for number in plan.configurations]
        theirs = plan.seeds if plan.configuration_seeds is None else plan.configuration_seeds
        networks = made(names, seeds=theirs)
        return [_Block(networks, plan.configuration_variants, (plan.configuration_view,), grid)]
    if section == "peers":
        peers = other(plan.peers, plan.case_peers)
        return [_Block(made(plan.models, peers), plan.variants, views, grid)]
    if section == "faults":
        draws = tuple(
            (fault, seed)
            for fault in plan.faults
            for seed in (plan.fault_seeds if fault != "clean" else (0,))
        )
        methods = one_seed(plan.fault_models, plan.fault_peers)
        return [_Block(methods, plan.fault_variants, (CLEAN_VIEW,), grid, draws)]
    if section == "views":
        return [_Block(one_seed(plan.models), plan.variants, plan.views, grid)]
    if section == "severity":
        return [disturbed(one_seed(plan.severity_models, plan.severity_peers), plan.severities)]
    located_by = one_seed(plan.resection_models)
    return [
        _Block(
            lambda methods: map(Cutting, [*located_by(methods), Truth()]),
            plan.variants,
            views,
            grid,
        )
    ]
