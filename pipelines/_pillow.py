"""Pictures are prepared with Pillow here, so that transformers need not tell everyone that torchvision is missing.

It does so when its image processor of CLIP is first looked for, which diffusers' pipelines do when they are imported.
"""

import logging

import transformers

_logger = logging.getLogger("transformers.utils.import_utils")
_level = _logger.level
_logger.setLevel(logging.ERROR)
try:
    getattr(transformers, "CLIPImageProcessor", None)
finally:
    _logger.setLevel(_level)
