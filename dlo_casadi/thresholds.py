"""Every number by which a result is accepted or refused, with what has set it.

What only steers a search (places that are tried, steps, meshes) stands where the search is, and how
noise is estimated in `estimation`. "Measured" means on the sessions of tests/data, by this program.
"""

from __future__ import annotations

# ---- score tests -------------------------------------------------------------------------------

# Probability of a false alarm in a complete model, over all candidates: one session in 200.
SIGNIFICANCE = 0.005
# Directions whose information is below this share of what it was before projection are not told
# apart from the fit's own: above the root of double precision, 1.5e-8, and below what signatures
# keep, measured on twelve sessions of centre-lines more than 1e-6.
COLLINEAR = 1e-7
# Scans at neighbouring places, a few hundredths of the length apart, are no independent tests: so
# many of them count as one.
SCANS_PER_TEST = 3
# An estimate of the noise counts as having at least so many degrees of freedom: up to there F has
# no variance. Student's t is 2.8 then, so that of less known noise intervals are too short.
LEAST_NOISE_DEGREES = 4.0
# Directions of the residual that keep less than this share of the noise's variance are the fit's
# own. Measured, a share of 0.001 or of 0.2 moves p in a complete session by less than 0.03.
KEPT_VARIANCE = 0.05
# The same for displacement fields, whose information is not whitened: only rounding is left out.
KEPT_INFORMATION = 1e-6

# ---- choice among candidates -------------------------------------------------------------------

# Candidates that are refitted at most in one step, and the share of the leading score below which
# one is not worth a refit. Measured on ten sessions in which something is hidden: its score is
# among the first three, and at least 0.99 of the leading one. The smaller of two has 0.02, and its
# turn in the next step.
REFITTED = 6
WORTH = 0.1
# Objective over the least one of fits that begin at the measured shapes up to which a candidate is
# fitted. In five sessions with a misfit the true effect had the least; of others a force in place
# of a tether had 1.35, a set in place of a drift 1.3 to 14, all others 3 and more.
NEAREST = 2.0
# An effect misleads if it makes the error of poses of which the ends alone are known larger by this
# factor. A judgement: a hanging weight that is right changed it from 10.9 to 11.2 mm, of which all
# but one millimetre is one pose on another equilibrium; a wrong effect from 6 to 178 mm.
MISLEADING = 1.25
# Standard errors of the mean difference of left-out poses beyond which a candidate predicts clearly
# worse: 95 % of a normal distribution.
CLEARLY_WORSE = 2.0
# A rival whose BIC falls short by more than this is told apart by the data ("very strong",
# Kass and Raftery 1995), whatever its cross-validated error.
BIC_APART = 10.0

# Different poses from which effects are told by how they change from pose to pose: few may differ
# by chance, as two hangings of one do. With 3 here, a missing force of 0.4 N passed for scatter in
# five poses; 6 is a judgement above that case, its power against others not measured.
DIFFERENT = 6

# ---- what an explanation has to do -------------------------------------------------------------

# A model is no explanation if a pose that is left out is predicted worse than so many times what
# noise, fixtures, parameters and the cable's scatter let expect, and, with effects, than this share
# of what it was without them. Measured, a complete model's error is 0.9 to 1.3 times (eight
# sessions); without the effect it is 0.85 and 1.6 times where that is small, and 3 to 41 times on
# the eight others.
UNSEEN = 2.0
UNSEEN_LEFT = 0.5
# Of the mean square error that the declared model makes beyond the noise, what effects beside an
# unexplained residual may leave. Measured, without their cause: a force for a drift leaves 0.38,
# a gradient, a scale and an offset for stretch 0.89; softening of a real glass-fibre strip 0.08.
LEFT = 0.1

# ---- what cannot be told apart -----------------------------------------------------------------

# A load so near to a held end (share of the length) bends the cable beyond it as an error of the
# fixture does: shapes show what is transmitted, not how it is applied (Saint-Venant).
NEAR_END = 0.1
# Standard deviations within which a force lies along gravity: 95 % of a normal distribution.
ALONG_GRAVITY = 2.0
# Absolute correlation of two nuisances beyond which their effects on the shapes are one: either's
# variance is then five times, 1 / (1 - 0.9^2), what it would be if the other were known.
ALIKE = 0.9

# Poses that repeat worse than this many times the noise limit every prediction. Noise alone gives
# (simulated, white and correlated over 3 % of the length) 1.1 to 1.3 with five hangings, 1.4 to 1.6
# with two, of which half may thus be flagged without need.
REPEATS = 1.5
# Repeats that differ by more than so many times the noise take its place. Below, chi-square per
# degree of freedom widens the intervals, and the shapes stay those of one line's noise.
REPEATS_ARE_NOISE = 2.0

# White errors of points, which no cable makes, that exceed the declared noise by this factor
# contradict it: three standard errors of the least degrees of freedom, 0.5 = 3 / sqrt(2 x 18). Of
# ten rendered sessions, most lacking an effect, they came out at 0.97 to 1.02 of the truth.
SCATTERED, SCATTERED_DEGREES = 1.5, 18

# ---- intervals ---------------------------------------------------------------------------------

# 95 % of a standard normal lies within this many standard deviations.
NORMAL_95 = 1.959964
# A stiffness is identifiable if its interval spans no more than this factor: of a wider one a
# number would claim what nobody knows.
IDENTIFIABLE = 10.0
# Where a declared noise is taken as white, the lines are still not trusted to be free of a
# smooth error of this share of it, which no number of points averages out. It is counted on top
# of the statistical error. An estimated correlation contains such errors already.
SYSTEMATIC_SHARE = 0.05
# Fixtures that move a prediction by more than this share of the noise get a warning: together both
# are a tenth more than the noise, sqrt(1 + 0.5^2).
FIXTURES = 0.5
# The mesh is refined until its error is below this share of the noise: it then adds half a percent
# to the error, sqrt(1 + 0.1^2), and a hundredth to chi-square.
MESH_SHARE = 0.1
# Where a model lacks something, the mesh's share of what is left: it adds 3 percent to that,
# sqrt(1 + 0.25^2), and is refined once the missing effect is in the model. Verdicts, effects and
# ties of 18 rendered sessions are those of a tenth.
LACKING_SHARE = 0.25

# ---- contradictions of the configuration -------------------------------------------------------

# Misfit of a line's ends, in lengths of the cable. Lines end up to 0.08 from their fixtures where a
# holder or a gap hides the cable; ends that fit are well below, ends that do not are well above.
FITS, CONTRADICTS = 0.04, 0.1
# Ends that fit another pose need not be as far from their own.
OUT_OF_STEP = 0.05
# An explanation leaves at most this share of the misfit.
MUCH_BETTER = 0.35
# A line longer than so many cables does not follow the cable.
TOO_LONG = 1.5
# RMS distance over the length that a coarse fit leaves: noise, and what its mesh and its few
# unknowns leave, is below the first. Effects that are missing left up to 0.0083 in four sessions
# in space, below the second: only beyond it does a fit refuse a session.
UNEXPLAINED, BEYOND_EFFECTS = 2e-3, 0.01
# Neighbouring markers farther apart than the cable between them, in lengths of the cable: half of
# what fits leaves noise of 3 mm (five times, of both) on a cable of 1 m.
STRETCHED = FITS / 2
# Distance of readings from a multiple of those that the shapes need, over their size: 0.02 in a
# session in space with a wrong mass (space_wrench), 0.6 and more with another sign or frame.
MISREAD = 0.15
# Fewest poses whose readings may be fitted by a turn of axes or a point of reference: with two and
# three, of 21 clean simulated sessions two were refused for a turn by -12 and by 73 degrees.
FITTED_READINGS = 4
# Ways to read them that are nearly as near as the best one are judged by how likely they are.
READ_OTHERWISE = 1.5
# What a mass may be wrong by: `mass_error` reaches from a fifth to five times.
READ_SCALE = 5.0
# How far a factor may be from that of a unit: the nearest two are 2.54 apart, more than 1.25^2.
NEAR_UNIT = 1.25
# Share of the poses that a common mistake shows in: a pose or two may be wrong by themselves.
NEARLY_ALL = 0.8
# What a clamp and a line may differ by [rad]; a clamp that is askew is up to 0.9 off. And what an
# explanation of more may leave.
HEADING_OFF, HEADING_NEAR = 1.0, 0.5

# ---- words -------------------------------------------------------------------------------------

# Normal scores of the residual's structure beyond it are worth a word: one in 370 by chance.
NOTABLE = 3.0
# Standard deviations of where two sides are equally low within which nobody knows which one a
# cable takes: 95 % of a normal distribution.
EITHER = 2.0
# Rivals so many standard deviations apart are told from one another: one in 370 by chance.
APART = 3.0
