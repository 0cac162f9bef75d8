"""Methods that the pipeline is compared with: oracle, plain method of the article, plain volume."""
