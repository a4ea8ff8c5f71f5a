"""Words asked of objects: their features told apart, compared where they differ, and calibrated."""

from splatseg.lift.words.answers import AnswerOptions as AnswerOptions
from splatseg.lift.words.answers import WordAnswers as WordAnswers
from splatseg.lift.words.answers import answer_words as answer_words
from splatseg.lift.words.answers import context_of as context_of
from splatseg.lift.words.context import CONTEXT_WORDS as CONTEXT_WORDS
from splatseg.lift.words.index import WordIndex as WordIndex
from splatseg.lift.words.object_features import ObjectFeatures as ObjectFeatures
from splatseg.lift.words.object_features import UnmixOptions as UnmixOptions
from splatseg.lift.words.object_features import object_features as object_features
from splatseg.lift.words.phrases import ThingLooks as ThingLooks
from splatseg.lift.words.phrases import answer_phrases as answer_phrases
from splatseg.lift.words.phrases import thing_looks as thing_looks
from splatseg.lift.words.span import WordSpan as WordSpan
from splatseg.lift.words.span import word_span as word_span
