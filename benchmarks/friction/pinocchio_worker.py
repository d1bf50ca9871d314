# SPDX-License-Identifier: Apache-2.0
"""Solve problems with Pinocchio's solvers for constraints, in the interpreter that has it (worker.py says how).

Its tolerances, proximal parameter and bounds of rho are numbers without units, so it gets the problem without units: W over the
mean of its diagonal, q over |q|. It orders a contact (t1, t2, n), and factorises one triangle of W, so it gets the symmetric part.
"""

import resource

import numpy as np
import pinocchio as pin
import scipy.sparse
import worker

SOLVERS = {
    "ADMM": (pin.ADMMConstraintSolver, pin.ADMMSolverSettings, pin.ADMMSolverResult),
    "PGS": (pin.PGSConstraintSolver, pin.PGSSolverSettings, pin.PGSSolverResult),
}
LANCZOS = 5  # vectors for the largest eigenvalue; as many as W has rows, the default, take most of the time where it is large

STACK = 2**26  # PGS keeps a copy of W there: 8 MiB, the usual limit, are too few for 356 contacts


def cones(mu):
    """Contacts with these friction coefficients, of a model that does nothing but carry them."""
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "body")
    models, data = pin.StdVec_ConstraintModel(), pin.StdVec_ConstraintData()
    for coefficient in mu:
        contact = pin.PointContactConstraintModel(model, 1, pin.SE3.Identity())
        contact.setFriction(float(coefficient))
        constraint = pin.ConstraintModel(contact)
        models.append(constraint)
        data.append(constraint.createData())
    return models, data


def settings(kind, rule, iterations, tolerance):
    """Exact Coulomb friction (solve_ncp), absolute tolerances of a problem without units."""
    chosen = SOLVERS[kind][1]()
    chosen.solve_ncp = True
    chosen.max_iterations = iterations
    chosen.absolute_feasibility_tol = tolerance
    chosen.relative_feasibility_tol = chosen.relative_complementarity_tol = 0.0
    # of a product under t both factors may be sqrt(t); ADMM comes closer than it must, and cannot reach the square
    chosen.absolute_complementarity_tol = tolerance if kind == "ADMM" else tolerance**2
    if kind == "ADMM":
        chosen.lanczos_size = LANCZOS
    if rule:
        chosen.admm_update_rule = getattr(pin.ADMMUpdateRule, rule)
    return chosen


def prepare(W, q, mu, solver, iterations, storage, tolerance):
    """A problem, to be solved from zero by one call; solver is ADMM, PGS or ADMM and one of its rules for rho."""
    kind, _, rule = solver.partition(" ")
    order = np.arange(len(q)).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    size, speed = W.diagonal().mean(), np.linalg.norm(q)
    scaled = scipy.sparse.csc_matrix((W + W.T) * (0.5 / size))[order][:, order]
    delassus = pin.DelassusOperatorDense(scaled.toarray()) if storage == "dense" else pin.DelassusOperatorSparse(scaled)
    free, chosen, (models, data) = q[order] / speed, settings(kind, rule.upper(), iterations, tolerance), cones(mu)
    engine, result = SOLVERS[kind][0](len(q)), SOLVERS[kind][2]()

    def answer():
        found, impulse = np.zeros(len(q)), np.zeros(len(q))
        result.retrievePrimalSolution(found)
        impulse[order] = found * (speed / size)
        return result.iterations, impulse

    return lambda: engine.solve(delassus, free, models, data, chosen, result), answer


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_STACK, (STACK, resource.getrlimit(resource.RLIMIT_STACK)[1]))
    worker.serve(prepare)
