"""Methods against held-out clips: a record of each clip, figures of all, how sure those are, and what is wanted."""

from gcd_train.evaluation.clips import EvaluationSet, HeldOutClip, SetKind
from gcd_train.evaluation.contact_sheet import write_contact_sheet
from gcd_train.evaluation.figures import Evaluation, Figures, figures, lead, summed_up
from gcd_train.evaluation.held_out import HeldOutClips, cameras_of, class_grid, require_same_kind, source_side
from gcd_train.evaluation.keeping import RunKeeper, folder_name, read_run
from gcd_train.evaluation.measured import measure
from gcd_train.evaluation.paired_set import PairedSet
from gcd_train.evaluation.record import REGIONS, ClipRecord, Region, RegionRecord, RunNote
from gcd_train.evaluation.report import Conditions, MountNumbers, Report, Shot, best_of, write_report
from gcd_train.evaluation.run import evaluate
from gcd_train.evaluation.spread import ClipWork, measure_all
from gcd_train.evaluation.synthesized import SynthesizedViews
from gcd_train.evaluation.tables import to_markdown
from gcd_train.evaluation.tallies import FIRST_MEASURED, MAIN, Selection, Tallies, tallies

__all__ = [
    "FIRST_MEASURED",
    "MAIN",
    "REGIONS",
    "ClipRecord",
    "ClipWork",
    "Conditions",
    "Evaluation",
    "EvaluationSet",
    "Figures",
    "HeldOutClip",
    "HeldOutClips",
    "MountNumbers",
    "PairedSet",
    "Region",
    "RegionRecord",
    "Report",
    "RunKeeper",
    "RunNote",
    "Selection",
    "SetKind",
    "Shot",
    "SynthesizedViews",
    "Tallies",
    "best_of",
    "cameras_of",
    "class_grid",
    "evaluate",
    "figures",
    "folder_name",
    "lead",
    "measure",
    "measure_all",
    "read_run",
    "require_same_kind",
    "source_side",
    "summed_up",
    "tallies",
    "to_markdown",
    "write_contact_sheet",
    "write_report",
]
