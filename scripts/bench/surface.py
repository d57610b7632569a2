"""Surface analysis of PLSR: all models from fold moments in one batch, beside one scikit-learn fit
per model and fold.

python scripts/bench/surface.py [--samples 20000] [--columns 30] [--share 0.02]

scikit-learn fits only a share of the models (drawn at random, seeded); its time for all is that
divided by the share. Both sides are timed in this process, on one thread. The errors of the models
that both have are compared.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch
from sklearn.cross_decomposition import PLSRegression
from threadpoolctl import threadpool_limits

from residnet.regression.shrinkage import FoldMoments
from residnet.regression.surface import surface

FOLDS = 5


def main() -> None:
    """Read the options; one thread for both."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--samples", type=int, default=20_000)
    parser.add_argument("--columns", type=int, default=30)
    parser.add_argument("--share", type=float, default=0.02)
    options = parser.parse_args()
    torch.set_num_threads(1)
    with threadpool_limits(1):
        compare(options)


def compare(options: argparse.Namespace) -> None:
    """Both on the same made data."""
    random = np.random.default_rng(0)
    latent = random.normal(size=(options.samples, options.columns // 2))
    x = latent @ random.normal(size=(options.columns // 2, options.columns)) + 0.3 * random.normal(
        size=(options.samples, options.columns)
    )
    y = latent[:, :3] + 0.2 * x[:, :3] ** 2 + random.normal(size=(options.samples, 3))
    fold = np.arange(options.samples) * FOLDS // options.samples

    began = time.perf_counter()
    moments = FoldMoments.gather(
        torch.from_numpy(x), torch.from_numpy(y), torch.from_numpy(fold), FOLDS
    )
    passed = time.perf_counter()
    found = surface(moments)
    ended = time.perf_counter()
    print(f"{options.samples} samples, {options.columns} basis functions, {FOLDS} folds, 3 outputs")
    print(f"own: one pass over the data {passed - began:.3f} s, computing {ended - passed:.3f} s")

    models = [
        (k, a + 1, j)
        for k in range(3)
        for a, j in torch.isfinite(found.error[k]).nonzero().tolist()
    ]
    chosen = [
        models[i]
        for i in random.permutation(len(models))[: max(round(options.share * len(models)), 1)]
    ]
    worst, began_reference = 0.0, time.perf_counter()
    for k, order, count in chosen:
        kept = found.kept(k, order, count)
        # each model of the surface costs one fit on all data (what to remove next) and one per fold
        PLSRegression(order).fit(x[:, kept], y[:, k])
        squares = 0.0
        for f in range(FOLDS):
            model = PLSRegression(order).fit(x[fold != f][:, kept], y[fold != f, k])
            squares += float(
                ((model.predict(x[fold == f][:, kept]).ravel() - y[fold == f, k]) ** 2).sum()
            )
        error = squares / options.samples
        worst = max(worst, abs(error - float(found.error[k, order - 1, count])) / error)
    reference = (time.perf_counter() - began_reference) * len(models) / len(chosen)
    print(f"scikit-learn: {len(chosen)} of {len(models)} models, {reference:.1f} s for all of them")
    print(
        f"ratio {reference / (ended - began):.0f} with the pass, {reference / (ended - passed):.0f}"
        f" without; errors differ by at most {worst:.1e}"
    )


if __name__ == "__main__":
    main()
