"""Predictors against held-out clips: figures of each clip, of all together, how sure those are, and what is wanted."""

from gcd_train.evaluation.bars import Bar, bars
from gcd_train.evaluation.contact_sheet import write_contact_sheet
from gcd_train.evaluation.figures import Evaluation, Figures, figures, lead, summed_up
from gcd_train.evaluation.held_out import HeldOutClips, cameras_of, class_grid, require_same_kind, source_side
from gcd_train.evaluation.measures import FIRST_MEASURED, Measures, TrueView, measure
from gcd_train.evaluation.report import Conditions, MountNumbers, Report, Shot, best_of, write_report
from gcd_train.evaluation.run import evaluate
from gcd_train.evaluation.synthesized import SynthesizedViews
from gcd_train.evaluation.tables import to_markdown

__all__ = [
    "FIRST_MEASURED",
    "Bar",
    "Conditions",
    "Evaluation",
    "Figures",
    "HeldOutClips",
    "Measures",
    "MountNumbers",
    "Report",
    "Shot",
    "SynthesizedViews",
    "TrueView",
    "bars",
    "best_of",
    "cameras_of",
    "class_grid",
    "evaluate",
    "figures",
    "lead",
    "measure",
    "require_same_kind",
    "source_side",
    "summed_up",
    "to_markdown",
    "write_contact_sheet",
    "write_report",
]
