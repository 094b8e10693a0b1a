"""From a located organ to a plan: which tumor to cut out, where to hold it, along which lines.

Two methods: ``margin`` (``facets``) and the paper's (``published``).
"""

from __future__ import annotations

from tumortrack_resection.drafts import Drafts
from tumortrack_resection.facets import TOOLS, Tools
from tumortrack_resection.values import Located, ResectionConfig, ResectionPlan


def plan_resection(
    located: Located, config: ResectionConfig, tools: Tools = TOOLS
) -> ResectionPlan:
    """A plan by itself, table frame, mm, as far as geometry goes; the arms may want another
    (``arms.procedure.plan_motions``). Raises InputError: no such tumor; NoPlan: nothing to cut, or
    not as asked."""
    return Drafts(located, config, tools).best().plan()
