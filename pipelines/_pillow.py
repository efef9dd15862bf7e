"""Pictures are prepared with Pillow here, so that transformers need not tell everyone that torchvision is missing.

It does so when diffusers' pipelines are imported, which look for its image processor of CLIP.
"""

import logging

logging.getLogger("transformers.utils.import_utils").addFilter(
    lambda record: "`CLIPImageProcessor` requires torchvision" not in record.getMessage()
)
