"""Stage 4, the autoencoder of pictures.

python -m unitouch_gen.training.image_vae --output runs/image_vae
"""

from unitouch_gen.training.autoencoder import train_autoencoder

if __name__ == "__main__":
    train_autoencoder("image_vae", "image")
