"""Keeps transformers from saying that torchvision is missing: pictures are prepared with Pillow here.

It says so when its image processor of CLIP is first looked for, which diffusers' pipelines do when they are imported.
"""

import logging

logging.getLogger("transformers.utils.import_utils").setLevel(logging.ERROR)
