"""What stages are trained on: data sets in their published layouts, or the built-in world."""

from unitouch_gen.training.data.cache import computed_once
from unitouch_gen.training.data.columns import DataConfig, Source, columns_of, sensor_numbers
from unitouch_gen.training.data.contacts import Contacts
from unitouch_gen.training.data.drawn import DrawnConfig, DrawnContacts
from unitouch_gen.training.data.records import Record
from unitouch_gen.training.data.sets import RecordSet, open_dataset

__all__ = [
    "Contacts",
    "DataConfig",
    "DrawnConfig",
    "DrawnContacts",
    "Record",
    "RecordSet",
    "Source",
    "columns_of",
    "computed_once",
    "open_dataset",
    "sensor_numbers",
]
