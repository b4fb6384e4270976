from .combine import combine as combine
from .files import load_capture as load_capture, save_capture as save_capture
from .schema import count as count, validate as validate
