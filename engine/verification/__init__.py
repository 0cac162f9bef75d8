"""Evidence that Tidegate works: phantom, evaluation, performance and QA."""
