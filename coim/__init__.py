"""Co-imagination of behaviour and morphology: components that improve a robot's body and controller together.

Everything that is public, in one flat list. Importing it starts nothing, reads nothing and prints nothing. A name is
imported when it is first asked for: losses and networks work where mujoco and pyswarms are not installed. Gymnasium
knows the bodies, such as ``coim/Hopper-v0``, when both are imported, in either order.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING

# First, before TorchRL imports mujoco itself: a missing OpenGL library is then said in one sentence.
import coim.envs
import coim.envs.gymnasium_ids
from coim.lazy import lazy_names, when_imported

if TYPE_CHECKING:
    from coim.batches import batch_parts, sample_batches, sample_mixture
    from coim.buffers import Buffers, TransitionBuffer, transition_rows
    from coim.coadaptation import CoAdaptation
    from coim.design_choice import DesignChoice, Situation
    from coim.designs import (
        DesignGenerator,
        DesignPosterior,
        DesignSearch,
        GradientSearch,
        KnownDesigns,
        NoisyDesigns,
        ParticleSwarm,
        RandomDesigns,
        TrustRegion,
    )
    from coim.envs import (
        AntMorph,
        GymnasiumEnv,
        HalfCheetahMorph,
        HopperMorph,
        MorphEnv,
        SimulatorDynamics,
        WalkerMorph,
        WorldModelEnv,
        morph_from_mjcf,
    )
    from coim.episode import run_episode
    from coim.events import DesignChosen, DesignDone, EpisodeDone, Event
    from coim.governor import Governor
    from coim.imagination import imagine
    from coim.imagined_replay import ImaginedReplay
    from coim.learners.dynamics import DynamicsLearner
    from coim.learners.sac import SACLearner
    from coim.models import (
        GaussianEnsemble,
        NetworkSizes,
        Policy,
        QValue,
        StackedMLP,
        make_policy,
        make_qvalue,
        select_run,
    )
    from coim.objectives import CoImSACLoss, DesignValue, EnsembleNLLLoss
    from coim.posterior_choice import PosteriorChoice
    from coim.run_folder import TriedDesign
    from coim.saved_run import Agent, SavedRun, TrainedBody, load_run
    from coim.updates import UpdatePlan
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "batches": ["batch_parts", "sample_batches", "sample_mixture"],
            "buffers": ["Buffers", "TransitionBuffer", "transition_rows"],
            "coadaptation": ["CoAdaptation"],
            "design_choice": ["DesignChoice", "Situation"],
            "designs": [
                "DesignGenerator",
                "DesignPosterior",
                "DesignSearch",
                "GradientSearch",
                "KnownDesigns",
                "NoisyDesigns",
                "ParticleSwarm",
                "RandomDesigns",
                "TrustRegion",
            ],
            "learners.dynamics": ["DynamicsLearner"],
            "envs": [
                "GymnasiumEnv",
                "AntMorph",
                "HalfCheetahMorph",
                "HopperMorph",
                "MorphEnv",
                "SimulatorDynamics",
                "WalkerMorph",
                "WorldModelEnv",
                "morph_from_mjcf",
            ],
            "episode": ["run_episode"],
            "events": ["DesignChosen", "DesignDone", "EpisodeDone", "Event"],
            "governor": ["Governor"],
            "imagination": ["imagine"],
            "imagined_replay": ["ImaginedReplay"],
            "learners.sac": ["SACLearner"],
            "models": [
                "GaussianEnsemble",
                "NetworkSizes",
                "Policy",
                "QValue",
                "StackedMLP",
                "make_policy",
                "make_qvalue",
                "select_run",
            ],
            "objectives": ["CoImSACLoss", "DesignValue", "EnsembleNLLLoss"],
            "saved_run": ["Agent", "SavedRun", "TrainedBody", "TriedDesign", "load_run"],
            "posterior_choice": ["PosteriorChoice"],
            "updates": ["UpdatePlan"],
        },
    )

when_imported("gymnasium", lambda: coim.envs.gymnasium_ids.register_bodies(coim.envs.__all__))

__version__ = "0.2.0"

__all__ = [
    "Agent",
    "AntMorph",
    "Buffers",
    "CoAdaptation",
    "CoImSACLoss",
    "DesignChoice",
    "DesignChosen",
    "DesignDone",
    "DesignGenerator",
    "DesignPosterior",
    "DesignSearch",
    "DesignValue",
    "DynamicsLearner",
    "EnsembleNLLLoss",
    "EpisodeDone",
    "Event",
    "GaussianEnsemble",
    "Governor",
    "GradientSearch",
    "GymnasiumEnv",
    "HalfCheetahMorph",
    "HopperMorph",
    "ImaginedReplay",
    "KnownDesigns",
    "MorphEnv",
    "NetworkSizes",
    "NoisyDesigns",
    "ParticleSwarm",
    "Policy",
    "PosteriorChoice",
    "QValue",
    "RandomDesigns",
    "SACLearner",
    "SavedRun",
    "SimulatorDynamics",
    "Situation",
    "StackedMLP",
    "TrainedBody",
    "TransitionBuffer",
    "TriedDesign",
    "TrustRegion",
    "UpdatePlan",
    "WalkerMorph",
    "WorldModelEnv",
    "batch_parts",
    "imagine",
    "load_run",
    "make_policy",
    "make_qvalue",
    "morph_from_mjcf",
    "run_episode",
    "sample_batches",
    "sample_mixture",
    "select_run",
    "transition_rows",
]

if not TYPE_CHECKING and find_spec("botorch") is None:  # it is optional, and "import *" asks for every name
    __all__.remove("DesignPosterior")
    __all__.remove("PosteriorChoice")
