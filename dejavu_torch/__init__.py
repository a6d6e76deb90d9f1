"""Scalable place recognition from repeating features, as differentiable PyTorch modules.

The method of Jacobson, Scheirer and Milford, "Déjà vu: Scalable Place Recognition Using Mutually
Supportive Feature Frequencies" (IROS 2017). From the paper's sections to the code:

    III    the whole method                      DejaVu              model
    III-A  spectrogram, two strongest periods    SpectrogramAnalysis periods.spectrogram
    III-A  layers of features with one period    FrequencyLayer      types, periods.spectrogram
    eq. 2  phase masks M(i, tau, k)              phase_mask          maps.templates
    eq. 1  templates mu(H, tau, k)               PhaseTemplates      maps.templates
           their map                             TemplateMapper      maps.template_map
    eq. 3  distance to every phase of a layer    phase_distances     maps.distance
    eq. 4  scores S(i) of all places             TemplateMap         maps.template_map
           any kind of map                       PlaceMap            maps.place_map
           where its places lie                  Layout              places.layout
           (ours) generalisation of templates    SpectralMapper      maps.spectral
    eq. 5  best place, eq. 6 acceptance          best_match          recognition.select
    IV-A   HOG features                          HOG, hog            features.hog
    IV-A   sliding window on an aerial image     SlidingWindow       data.strip
    IV-B   velocity from the ground              GroundOdometry      motion.odometry, motion.resampling
    IV-A   (ours) channel, local contrast        Preprocess          features.preprocess
           (ours) few, distinctive dimensions    Whitening           features.whitening
    IV-C   precision, recall, area               evaluate            evaluation.curves
    V      (ours) with baselines and nulls       compare             evaluation.compare
           what it learns from and reports       Learning, Reporting evaluation.options
           how its queries are matched           Querying            recognition.querying
    VI     (ours) several consecutive queries    SequenceMatcher     recognition.sequence
    VI     (ours) probabilities along the way    PlaceFilter         recognition.filter
    VI     (ours) given the whole drive          PlaceSmoother       recognition.smoother
    VI     (ours) frames from a camera           LiveLocalizer       live.localizer
    VI     (ours) features of few frequencies    DescriptorTask       training.descriptors
    VI     (ours) features trained to repeat     TemplateTask         training.templates
           frames to train on                    RouteData           training.datamodule
           any backbone                          Embedding           features.embedding
           imposed instead of found periods      ImposedPeriods      periods.imposed
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dejavu_torch.lazy import homes_of, lazily
from dejavu_torch.version import __version__ as __version__

if TYPE_CHECKING:
    from dejavu_torch.data.source import open_source as open_source
    from dejavu_torch.evaluation.compare import compare as compare
    from dejavu_torch.evaluation.curves import evaluate as evaluate
    from dejavu_torch.evaluation.options import Learning as Learning
    from dejavu_torch.evaluation.options import Reporting as Reporting
    from dejavu_torch.features.embedding import Embedding as Embedding
    from dejavu_torch.features.hog import HOG as HOG
    from dejavu_torch.features.hog import hog as hog
    from dejavu_torch.features.preprocess import Preprocess as Preprocess
    from dejavu_torch.features.whitening import Whitening as Whitening
    from dejavu_torch.live.localizer import LiveLocalizer as LiveLocalizer
    from dejavu_torch.maps.distance import phase_distances as phase_distances
    from dejavu_torch.maps.place_map import PlaceMap as PlaceMap
    from dejavu_torch.maps.spectral import SpectralMapper as SpectralMapper
    from dejavu_torch.maps.template_map import TemplateMap as TemplateMap
    from dejavu_torch.maps.template_map import TemplateMapper as TemplateMapper
    from dejavu_torch.maps.templates import PhaseTemplates as PhaseTemplates
    from dejavu_torch.maps.templates import phase_mask as phase_mask
    from dejavu_torch.model import DejaVu as DejaVu
    from dejavu_torch.motion.odometry import GroundOdometry as GroundOdometry
    from dejavu_torch.periods.imposed import ImposedPeriods as ImposedPeriods
    from dejavu_torch.periods.spectrogram import SpectrogramAnalysis as SpectrogramAnalysis
    from dejavu_torch.places.layout import Layout as Layout
    from dejavu_torch.recognition.filter import PlaceFilter as PlaceFilter
    from dejavu_torch.recognition.querying import Querying as Querying
    from dejavu_torch.recognition.select import best_match as best_match
    from dejavu_torch.recognition.sequence import SequenceMatcher as SequenceMatcher
    from dejavu_torch.recognition.smoother import PlaceSmoother as PlaceSmoother
    from dejavu_torch.text import InputError as InputError
    from dejavu_torch.training.datamodule import RouteData as RouteData
    from dejavu_torch.training.descriptors import DescriptorTask as DescriptorTask
    from dejavu_torch.training.templates import TemplateTask as TemplateTask
    from dejavu_torch.types import FrequencyLayer as FrequencyLayer
    from dejavu_torch.types import Match as Match
    from dejavu_torch.types import Traverse as Traverse

# the module of each name, imported on first use
_NAMES = {
    "data.source": "open_source",
    "evaluation.compare": "compare",
    "evaluation.curves": "evaluate",
    "evaluation.options": "Learning Reporting",
    "features.embedding": "Embedding",
    "features.hog": "HOG hog",
    "features.preprocess": "Preprocess",
    "features.whitening": "Whitening",
    "live.localizer": "LiveLocalizer",
    "maps.distance": "phase_distances",
    "maps.place_map": "PlaceMap",
    "maps.spectral": "SpectralMapper",
    "maps.template_map": "TemplateMap TemplateMapper",
    "maps.templates": "PhaseTemplates phase_mask",
    "model": "DejaVu",
    "motion.odometry": "GroundOdometry",
    "periods.imposed": "ImposedPeriods",
    "periods.spectrogram": "SpectrogramAnalysis",
    "places.layout": "Layout",
    "recognition.filter": "PlaceFilter",
    "recognition.querying": "Querying",
    "recognition.select": "best_match",
    "recognition.sequence": "SequenceMatcher",
    "recognition.smoother": "PlaceSmoother",
    "text": "InputError",
    "training.datamodule": "RouteData",
    "training.descriptors": "DescriptorTask",
    "training.templates": "TemplateTask",
    "types": "FrequencyLayer Match Traverse",
}
_HOMES = homes_of(_NAMES)
__all__ = sorted(_HOMES)
__getattr__, __dir__ = lazily(__name__, _NAMES)
