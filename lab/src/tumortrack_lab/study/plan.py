"""What the study measures: every number that decides a figure, and the jobs that follow."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import product
from typing import Literal, NamedTuple, TypeVar, get_args

from tumortrack.core.config import Config
from tumortrack_lab.study.bound import BOUNDS
from tumortrack_lab.study.goals import RIGID
from tumortrack_lab.study.measure import CLEAN_VIEW, Job
from tumortrack_lab.study.methods import CLINIC, UNREFINED, Method, Network, StudyCase
from tumortrack_lab.study.resection import Truth, cutting
from tumortrack_lab.twin.faults import FAULTS
from tumortrack_lab.twin.views import VARIANTS, VIEWS

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
    "accuracy", "goals", "ablation", "deformation", "faults", "views", "severity", "resection",
]  # fmt: skip
SECTIONS: tuple[Section, ...] = get_args(Section)
T = TypeVar("T")


class StudyPlan(Config, frozen=True):
    """What is measured. Severities are measured beside the clean scene, which is the end of most
    curves. None: the same as the phantom's."""

    name: str
    # In accuracy and views: M_lim, M_full, clinic
    models: tuple[str, ...] = ("M_lim", "M_full", CLINIC)
    steps: int = 12_000  # Of training M_lim and M_full
    clinic_steps: int = 6_000  # Of training clinic (the preset's)
    # Of training in the deformation study (as many as --steps)
    configuration_steps: int | None = None
    seeds: tuple[int, ...] = (0, 1, 2)  # Of training: of network, scenes and elastic body
    case_seeds: tuple[int, ...] | None = None  # Of training for --case (the same as the phantom's)
    # Of training in the deformation study (the same as the phantom's)
    configuration_seeds: tuple[int, ...] | None = None
    variants: tuple[str, ...] = tuple(VARIANTS)  # Of every table that names no others
    view: str = "noise"  # Of every table but those of faults and views
    grid: int = 160  # Voxels along the longest side (the paper's: 400)
    configurations: tuple[int, ...] = (1, 2, 3, 4, 5, 6)  # Rows of the paper's deformation table
    configuration_variants: tuple[str, ...] = ("D0", "D1", "D2", "D3")  # In the deformation study
    # Methods and bounds beside the models
    peers: tuple[str, ...] = (RIGID, *BOUNDS, "rigid", "cpd", "elastic")
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


class Methods(NamedTuple):
    """Where methods come from: trained models, peers (and bounds) made ready for a patient, models
    of the ablation."""

    model: Callable[[StudyCase, str, int], Network]
    peer: Callable[[str, StudyCase], Method]
    ablated: Callable[[StudyCase, str, int], Network]


class _Block(NamedTuple):
    """Models (names and seeds) and peers on every scene under every fault (with the seed of its
    random part)."""

    models: Iterable[tuple[str, int]]
    peers: Sequence[str]
    variants: tuple[str, ...]
    views: tuple[str, ...]
    grid: int
    faults: Sequence[tuple[str, int]] = (("none", 0),)


def jobs_of(
    plan: StudyPlan, section: Section, cases: tuple[StudyCase, ...], methods: Methods
) -> list[Job]:
    """The jobs of one section, grouped by method. Models that are not trained yet are trained.

    ``cases``: for ``deformation`` the second phantom; for faults, views and severities, which have
    the first seed alone, the paper's phantom; for accuracy and goals every case and the second
    phantom; for all others every case.
    """
    model = methods.ablated if section == "ablation" else methods.model
    jobs = []
    for case in cases:
        for block in _blocks(plan, section, case):
            made: list[Method] = [model(case, *one) for one in block.models]
            made += [methods.peer(name, case) for name in block.peers]
            also = cutting() if section == "resection" else {}
            made += [Truth()] if also else []
            for one, view, fault, variant in product(
                made, block.views, block.faults, block.variants
            ):
                jobs.append(Job(case, one, variant, view, block.grid, *fault, also))
    # Each method's follow one another: a model is loaded once.
    methods_in_order = list(dict.fromkeys(id(job.method) for job in jobs))
    return sorted(jobs, key=lambda job: methods_in_order.index(id(job.method)))


def scenes_of(
    plan: StudyPlan, section: Section, case: StudyCase
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Variants and views that a section needs; the clean view always, for it says what is
    visible."""
    blocks = _blocks(plan, section, case)
    variants = dict.fromkeys(variant for block in blocks for variant in block.variants)
    views = dict.fromkeys(view for block in blocks for view in block.views)
    return tuple(variants), tuple(dict.fromkeys((CLEAN_VIEW, *views)))


def _blocks(plan: StudyPlan, section: Section, case: StudyCase) -> list[_Block]:
    def for_case(ours: T, theirs: T | None) -> T:
        return ours if case.is_paper or theirs is None else theirs

    seeds = for_case(plan.seeds, plan.case_seeds)
    grid, usual, clean = plan.grid, (plan.variants, (plan.view,)), (CLEAN_VIEW,)

    def trained(models: Iterable[str], of: Sequence[int] = seeds) -> list[tuple[str, int]]:
        return list(product(models, of))

    def known(peers: Sequence[str]) -> list[str]:
        return [name for name in peers if name in plan.peers]

    def disturbed(models: list[tuple[str, int]], peers: Sequence[str], levels: tuple) -> _Block:
        draws = (("clean", 0), *product(levels, plan.severity_seeds))
        return _Block(models, peers, plan.severity_variants, clean, grid, draws)

    once, own = seeds[:1], trained((CLINIC,))
    configurations = [f"configuration_{number}" for number in plan.configurations]
    of = plan.seeds if plan.configuration_seeds is None else plan.configuration_seeds
    draws = [(f, s) for f in plan.faults for s in (plan.fault_seeds if f != "clean" else (0,))]
    ablation = _Block(
        trained(plan.ablation_models, plan.ablation_seeds), (),
        plan.ablation_variants, plan.ablation_views, grid,
    )  # fmt: skip
    blocks: dict[Section, list[_Block]] = {
        "accuracy": [
            _Block(trained(plan.models), for_case(plan.peers, plan.case_peers), *usual, grid)
        ],
        "goals": [_Block(own, (RIGID,), *usual, grid), disturbed(own[:1], (), (_HIDDEN,))],
        "ablation": [ablation] * (case.name in plan.ablation_cases),
        "deformation": [
            _Block(trained(configurations, of), (), plan.configuration_variants,
                   (plan.view,), grid)
        ],
        "faults": [
            _Block(trained(plan.fault_models, once), known(plan.fault_peers),
                   plan.fault_variants, clean, grid, draws)
        ],
        "views": [_Block(trained(plan.models, once), (), plan.variants, plan.views, grid)],
        "severity": [
            disturbed(trained(plan.severity_models, once), known(plan.severity_peers),
                      plan.severities)
        ],
        "resection": [_Block(trained(plan.resection_models, once), (), *usual, grid)],
    }  # fmt: skip
    return blocks[section]
