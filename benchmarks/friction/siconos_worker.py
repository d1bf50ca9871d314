# SPDX-License-Identifier: Apache-2.0
"""Solve problems with Siconos, in the interpreter that has it (worker.py says how)."""

import numpy as np
import scipy.sparse
import siconos.numerics as sn
import worker


def matrix(W, storage):
    """W as one of Siconos' storages: dense, sbm (blocks of 3 x 3), csc."""
    if storage == "dense":
        return np.asfortranarray(W.toarray())
    columns = scipy.sparse.csc_matrix(W)
    columns.indices, columns.indptr = columns.indices.astype(np.int64), columns.indptr.astype(np.int64)
    return sn.SBM_from_csparse(3, columns)[1] if storage == "sbm" else columns


def prepare(W, q, mu, solver, iterations, storage, tolerance):
    """A problem, to be solved from zero by the driver."""
    problem = sn.FrictionContactProblem(3, matrix(W, storage), q, mu)
    options = sn.SolverOptions(getattr(sn, "SICONOS_FRICTION_3D_" + solver))
    options.dparam[sn.SICONOS_DPARAM_TOL] = tolerance
    options.iparam[sn.SICONOS_IPARAM_MAX_ITER] = iterations
    impulse, velocity = np.zeros(len(q)), np.zeros(len(q))
    return (
        lambda: sn.fc3d_driver(problem, impulse, velocity, options),
        lambda: (options.iparam[sn.SICONOS_IPARAM_ITER_DONE], impulse),
    )


if __name__ == "__main__":
    worker.serve(prepare)
