"""The article's experiments, and the instruments they are judged with: laser line, spirometer, virtual datasets."""
