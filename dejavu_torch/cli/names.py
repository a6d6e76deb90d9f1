"""The commands, in the order in which messages name them."""

COMMANDS = {  # and what `dejavu --help` says of them
    "demo": "learn the built-in route, localize a second traverse of it, report",
    "learn": "learn a map",
    "localize": "find the frames of a source on a map",
    "live": "find the frames of a camera on a map, one by one",
    "compare": "learn, localize and evaluate, beside baselines and null control",
    "evaluate": "evaluate the matches in a csv, whatever found them",
    "reproduce": "the paper's experiments on simulated routes, beside its own numbers",
    "train": "train features that repeat: fit, validate, test or export",
    "merge": "join the maps of several routes",
    "export": "write a map, and what is ahead of it, as an ONNX file",
    "info": "what is in a map",
    "completion": "print a script by which bash or zsh completes all this",
}
FIRST_DAY = ("demo", "compare", "learn", "localize", "info")  # what `dejavu --help` begins with
