"""Measures motion in mm from RGB-D frames: stages, breathing, learning, tracking and the pipeline."""

from typing import TYPE_CHECKING

from engine.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from engine.motion.learning.model_file import (
        ARRAYS as ARRAYS,
        OPTIONAL_ARRAYS as OPTIONAL_ARRAYS,
        header_text as header_text,
        load_model as load_model,
        save_model as save_model,
    )
    from engine.motion.learning.patient_match import (
        PATIENT_MATCH_BOUNDS as PATIENT_MATCH_BOUNDS,
        PatientMatchLimits as PatientMatchLimits,
    )
    from engine.motion.learning.position_fit import (
        MARKER_PLACEMENT_MM as MARKER_PLACEMENT_MM,
        rigid_between as rigid_between,
    )
    from engine.motion.learning.tasks import (
        Outcome as Outcome,
    )
    from engine.motion.learning.trainer import (
        TRAINING_BOUNDS as TRAINING_BOUNDS,
        BackgroundTrainer as BackgroundTrainer,
        Trainer as Trainer,
        TrainingSettings as TrainingSettings,
    )
    from engine.motion.named_regions import (
        MAX_REGIONS as MAX_REGIONS,
        MAX_VERTICES as MAX_VERTICES,
        MIN_VERTICES as MIN_VERTICES,
        NAME_PATTERN as NAME_PATTERN,
        NamedRegion as NamedRegion,
        check_regions as check_regions,
        load_regions as load_regions,
        parse_region as parse_region,
    )
    from engine.motion.pipeline import (
        Pipeline as Pipeline,
    )
    from engine.motion.settings import (
        MARKER_PLACEMENT_BOUNDS as MARKER_PLACEMENT_BOUNDS,
        PipelineSettings as PipelineSettings,
    )
    from engine.motion.stages.regions import (
        MIN_PART_ROWS as MIN_PART_ROWS,
    )
    from engine.motion.stages.surface import (
        surface_mesh as surface_mesh,
    )
    from engine.motion.training_process.process_trainer import (
        ProcessTrainer as ProcessTrainer,
    )

__getattr__, __all__ = lazy_exports(__name__)
