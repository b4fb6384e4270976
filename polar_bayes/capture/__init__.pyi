from .combine import combine as combine
from .files import load_capture as load_capture, save_capture as save_capture
from .plausibility import (
    IndexByEye as IndexByEye,
    cautions as cautions,
    index_sentences as index_sentences,
    indices_by_eye as indices_by_eye,
    inferred as inferred,
    stated as stated,
)
from .schema import count as count, validate as validate
