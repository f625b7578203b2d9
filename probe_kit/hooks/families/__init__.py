"""One folder per model family: sites, loading and verification; `shared` holds code of several families."""
