from .dense_kernels import LatentKernels as LatentKernels
from .engines import (
    ENGINES as ENGINES, Choice as Choice, Engine as Engine, Exact as Exact, Inducing as Inducing,
    ProblemSize as ProblemSize, choose_engine as choose_engine, engine_from_dict as engine_from_dict,
    engine_of as engine_of,
)
from .inducing import InducingPosterior as InducingPosterior
from .likelihood import Terms as Terms, negative_log_likelihood as negative_log_likelihood
from .memory import require_memory as require_memory
from .optimization import (
    OptimizationResult as OptimizationResult, OptimizerOptions as OptimizerOptions, best_of as best_of,
    minimize_objective as minimize_objective,
)
from .posterior import ExactPosterior as ExactPosterior, LatentPosterior as LatentPosterior, exact as exact
