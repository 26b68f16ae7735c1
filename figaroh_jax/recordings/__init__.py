"""From files of numbers to signals of equal spacing: `tables`, `dataset`, `resampling`, `signals`, `stacked`."""
