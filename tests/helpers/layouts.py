"""Small trees in exactly the layouts that data sets are published in, and those of one's own."""

import shutil
from pathlib import Path

import numpy as np

from tests.helpers.data_sets import painted, shade, write_attempts, write_image

ONE = "20220601_182052"
TWO = "20220602_101010"
THREE = "20220603_090000"


def write(folder: Path, files: dict) -> None:
    """Images of the colours of numbers, and texts; a folder of no content is removed."""
    for name, content in files.items():
        if content is None:
            shutil.rmtree(folder / name)
        elif isinstance(content, int):
            write_image(folder / name, shade(content))
        else:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(content)


def touch_and_go(folder: Path) -> None:
    for number, recording in enumerate((ONE, TWO, THREE)):
        for frame in range(3):
            write(
                folder,
                {
                    f"dataset/{recording}/gelsight_frame/{frame:010d}.jpg": 10 * number + frame,
                    f"dataset/{recording}/video_frame/{frame:010d}.jpg": 40 + frame,
                },
            )
    first = f"{ONE}/0000000000.jpg"
    third = f"{TWO}/0000000002.jpg"
    label = f"{first},3\n{ONE}/0000000001.jpg,-1\n{third}, 7\n{THREE}/0000000001.jpg,19\n"
    write(
        folder,
        {
            "label.txt": label,
            "train.txt": f"{first},3\n",
            "test.txt": f"{third},7\n",
            "train_rough.txt": f"{first},1\n",
            "test_rough.txt": f"{third},-1\n",
        },
    )


def feeling_of_success(folder: Path) -> None:
    """Eleven attempts, so that i10 comes after i9, and one in another file."""

    def attempt(number: int) -> dict:
        numbers = {"gelsightA_during": number, "gelsightB_during": 20 + number, "kinectA_rgb_during": 40 + number}
        arrays = {name: painted(shade(at)) for name, at in numbers.items()}
        arrays |= {f"gelsight{finger}_before": painted(shade(60)) for finger in "AB"}
        return {"object_name": np.bytes_(f"object_{number}"), "is_gripping": np.bool_(number % 2 == 0), **arrays}

    write_attempts(folder / "calandra_corl2017_000.h5", [attempt(number) for number in range(11)])
    write_attempts(folder / "calandra_corl2017_001.h5", [attempt(12)])


def ycb_slide(folder: Path) -> None:
    run = "real/035_drill/dataset_0"
    write(folder, {f"sim/004_box/00/tactile_images/{number}.jpg": number for number in (2, 10)})
    write(folder, {f"{run}/frames/frame_7.jpg": 1, f"{run}/webcam_frames/frame_7.jpg": 2})
    write(folder, {f"real/004_box/dataset_1/frames/frame_{number}.jpg": 20 + number for number in (0, 1)})


def object_folder(folder: Path) -> None:
    for number, item in enumerate(("7", "101")):
        write(folder, {f"touch/{item}/{point}.png": point + 2 * number for point in range(2)})
        write(folder, {f"vision/{item}/{point}.png": 10 + point + 2 * number for point in range(2)})
    write(folder, {"label.json": '{"7": 0, "101": 6}', "split.json": '{"train": [["7", 0]], "test": [["101", 1]]}'})


def object_folder_real(folder: Path) -> None:
    write(folder, {f"{item}/tactile_data/3/0/gelsight/{at}.png": at for item, at in (("1", 2), ("1", 10), ("2", 0))})
    write(folder, {"objects.csv": "ID;Name;Material\n1;Bowl;Wood\n2;Fork;\n"})


def ssvtp(folder: Path) -> None:
    for number in (1, 2, 30):
        write(
            folder,
            {
                f"images_tac/image_{number}_tac.jpg": number,
                f"images_rgb/image_{number}_rgb.jpg": 10 + number,
                f"text/labels_{number}.txt": f"smooth, number {number}\n",
            },
        )
    write(
        folder,
        {
            f"{split}.csv": f"url,tactile\nimages_rgb/image_{number}_rgb.jpg,x\n"
            for split, number in (("train", 1), ("test", 30))
        },
    )


def hct(folder: Path) -> None:
    rows = ["url,tactile,tactile_background,caption"]
    for session in ("one", "two"):
        write(folder, {f"data1/{session}/background/0.jpg": 0})
        for number in range(3):
            write(
                folder,
                {
                    f"data1/{session}/tactile/{number}-0.5.jpg": 1 + number % 2,
                    f"data1/{session}/vision/{number}-0.5.jpg": 63 - number,
                },
            )
            picture, touch = (f"{session}/{place}/{number}-0.5.jpg" for place in ("vision", "tactile"))
            rows.append(f'{picture},{touch},{session}/background/0.jpg,"soft, {number}"')
    write(folder, {"data1/train.csv": "\n".join(rows)})


def tacquad(folder: Path) -> None:
    for sensor, touches, pictures in (("gelsight", 12, 6), ("digit", 2, 4), ("duragel", 6, 0)):
        write(folder, {f"data_indoor/mug/{sensor}/{number}.png": number for number in range(touches)})
        write(folder, {f"data_indoor/mug/img_{sensor}/{number}.png": 20 + number for number in range(pictures)})
    write(folder, {"contact_indoor.csv": "mug,10,11,0,1,3,3\n"})


def table(folder: Path) -> None:
    rows = (
        "touch,picture,background,sensor,material,object,caption,split,hardness",
        'a.png,b.png,c.png,digit,wood,one,"rough, and hard",train,2',
        "b.png,,c.png,gelsight,glass,two,smooth,test,-1",
        "c.png,b.png,,digit,,three,,train,10",
    )
    write(folder, {"a.png": 0, "b.png": 1, "c.png": 2, "labels.csv": "\n".join(rows)})


def tree(folder: Path) -> None:
    write(
        folder,
        {
            "touch/wood/2.png": 2,
            "touch/wood/10.png": 10,
            "touch/wood/background.png": 40,
            "touch/11.png": 11,
            "picture/wood/2.jpg": 20,
            "picture/wood/10.png": 30,
            "background/wood/2.bmp": 41,
        },
    )


def tree_of_splits(folder: Path) -> None:
    write(folder, {"train/wood/1.png": 0, "train/glass/1.PNG": 1, "test/wood/1.png": 2, "test/wood/.hidden.png": 3})


def tree_of_objects(folder: Path) -> None:
    write(
        folder, {"Train/wood/plank/1.png": 1, "Train/wood/2.png": 2, "VALID/glass/jar/3.png": 3, "test/glass/4.png": 4}
    )
