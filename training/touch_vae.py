"""Stage 7, the autoencoder of touch images.

python -m unitouch_gen.training.touch_vae --output runs/touch_vae
"""

from unitouch_gen.training.autoencoder import train_autoencoder

if __name__ == "__main__":
    train_autoencoder("touch_vae", "touch")
