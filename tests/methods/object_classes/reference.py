"""Classes of objects by loops: the equations of `methods.object_classes.classify`, one by one."""

import numpy as np

from splatseg.methods.object_classes import classify as constants


def classified(votes, features, *, known):
    """Probabilities (objects, classes), float64."""
    count, classes = votes.shape
    total = votes.sum(axis=1)
    shares = votes / total[:, None]
    weight = np.minimum(total / constants.FULL_VOTES, 1.0) * known
    log_votes = constants.VOTE_EXPONENT * np.log(shares + constants.VOTE_FLOOR)
    answers = softmax(log_votes)
    whitened = whiten(features, weight, constants.FEATURE_COMPONENTS)
    for _ in range(constants.ROUNDS):
        within = within_covariance(whitened, answers, weight, constants.SHRINKAGE)
        values, axes = np.linalg.eigh(within)
        within = axes @ np.diag(values.clip(0.02, 0.98)) @ axes.T
        between = np.eye(len(values)) - within
        scores = np.zeros((count, classes))
        for k in range(count):
            for c in range(classes):
                others = [j for j in range(count) if j != k]
                size = sum(weight[j] * answers[j, c] for j in others)
                total_feature = sum(weight[j] * answers[j, c] * whitened[j] for j in others)
                precision = np.linalg.inv(between) + size * np.linalg.inv(within)
                spread = np.linalg.inv(precision)
                mean = spread @ np.linalg.inv(within) @ total_feature
                scores[k, c] = log_normal(whitened[k], mean, within + spread)
            if not known[k]:
                scores[k] = 0
        answers = softmax(log_votes + constants.FEATURE_EXPONENT * scores)
    return answers


def whiten(features, weight, components):
    mean = (features * weight[:, None]).sum(axis=0) / weight.sum()
    centred = features - mean
    centred = centred / np.sqrt((centred**2 * weight[:, None]).sum(axis=0) / weight.sum())
    covariance = (centred * weight[:, None]).T @ centred / weight.sum()
    values, axes = np.linalg.eigh(covariance)
    values, axes = values[::-1][:components], axes[:, ::-1][:, :components]
    return centred @ axes / np.sqrt(values)


def within_covariance(features, answers, weight, shrinkage):
    scatter, freedom = 0.0, 0.0
    for c in range(answers.shape[1]):
        own = answers[:, c] * weight
        mean = (own[:, None] * features).sum(axis=0) / own.sum()
        for j in range(len(features)):
            scatter = scatter + own[j] * np.outer(features[j] - mean, features[j] - mean)
        freedom += own.sum() * (1 - (own**2).sum() / own.sum() ** 2)
    covariance = scatter / freedom
    level = np.trace(covariance) / len(covariance)
    return (1 - shrinkage) * covariance + shrinkage * level * np.eye(len(covariance))


def log_normal(x, mean, covariance):
    difference = x - mean
    distance = difference @ np.linalg.inv(covariance) @ difference
    return -0.5 * (distance + np.log(np.linalg.det(covariance)))


def softmax(scores):
    values = np.exp(scores - scores.max(axis=1, keepdims=True))
    return values / values.sum(axis=1, keepdims=True)
