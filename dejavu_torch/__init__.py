"""Scalable place recognition from repeating features, as differentiable PyTorch modules.

The method of Jacobson, Scheirer and Milford, "Déjà vu: Scalable Place Recognition Using Mutually
Supportive Feature Frequencies" (IROS 2017). Where each part of the paper lives:

    III    the whole method                      DejaVu              model
    III-A  spectrogram, two strongest periods    SpectrogramAnalysis periods.spectrogram
    III-A  layers of features of like period     FrequencyLayer      types, periods.layers
    eq. 2  phase masks M(i, tau, k)              phase_mask          database.phase
    eq. 1  templates mu(H, tau, k)               PhaseTemplates      database.phase
           the map they make, as one file        CompressedMap       database.compressed, database.mapfile
    eq. 3  distance to every phase of a layer    phase_distances     database.distance
    eq. 4  scores S(i) of all places             Matcher             database.scores
    eq. 5  best place, eq. 6 acceptance          best_match          recognition.select
    IV-A   HOG features                          HOG, hog            features.hog
    IV-A   window slid along an aerial image     SlidingWindow       data.strip
    IV-B   velocity from the ground              GroundOdometry  motion.odometry, motion.resampling
    IV-A   (ours) channel, local contrast        Preprocess          features.preprocess
    IV-C   precision, recall, area               pr_curve, evaluate  evaluation.curves
"""

from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.folder import ImageFolder
from dejavu_torch.data.simulate.aerial import AerialRoad
from dejavu_torch.data.source import open_source
from dejavu_torch.data.strip import SlidingWindow
from dejavu_torch.database.compressed import CompressedMap
from dejavu_torch.database.distance import phase_distances
from dejavu_torch.database.phase import PhaseTemplates, phase_mask
from dejavu_torch.database.scores import Matcher
from dejavu_torch.database.summary import MapSummary
from dejavu_torch.evaluation.curves import evaluate, pr_curve
from dejavu_torch.features.hog import HOG, hog
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.model import DejaVu
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.recognition.select import best_match
from dejavu_torch.types import FrequencyLayer, InputError, Match, PRCurve, Traverse

__version__ = "0.1.0"

__all__ = [
    "HOG",
    "AerialRoad",
    "ArrayTraverse",
    "CompressedMap",
    "DejaVu",
    "FrequencyLayer",
    "GroundOdometry",
    "ImageFolder",
    "InputError",
    "MapSummary",
    "Match",
    "Matcher",
    "PRCurve",
    "PhaseTemplates",
    "Preprocess",
    "SlidingWindow",
    "SpectrogramAnalysis",
    "Traverse",
    "best_match",
    "evaluate",
    "hog",
    "open_source",
    "phase_distances",
    "phase_mask",
    "pr_curve",
]
