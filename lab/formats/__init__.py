"""Files that come in and go out: recording sets, raw frames, cameras, scenes, results, other labs' formats."""
