"""Every threshold of the identification: value, unit, meaning and origin, each once.

A module imports the numbers that it needs. Below a value stands ``unit: Meaning. origin``; docs/settings.md is the
table of all, in this order (``python -m benchmarks.settings --write``). An origin begins with its kind: a principle,
physics, numerics, a benchmark that chose the value, a budget of work, or a judgement where nothing else decides.
"""

# ---- Least squares --------------------------------------------------------------------------------------------------
NINETY = 1.645
"""standard errors: An interval goes so far to each side. principle: it holds the true value nine times in ten"""
EVIDENCE = 200.0
"""observations: A log counts as at most so many independent observations of an output when intervals are made.
benchmark: intervals cover the simulated truth as often as they say; errors of form do not average out"""
LEAST_STEP_FALL = 1e-3
"""share: A fit goes on where a step lowers its cost by this share, if the model's own parameters are known roughly.
budget of work: parameters that are known roughly creep on for long"""
DAMPING_TIMES = (0.01, 1.0, 300.0)
"""1: A Levenberg-Marquardt iteration tries the last damping times each of these at one time.
budget of work: the three are simulated together"""
MOST_DAMPED = 4
"""tries: An iteration tries at most so many rounds of ever shorter steps.
numerics: the last is some 1e-15 of a full step"""
PROMISE_KEPT = 0.5
"""share: A step must bring this share of what its slopes promised, else the slopes are not relied on any further.
principle: gain ratio of a trust region (Nocedal and Wright, Numerical Optimization, ch. 4)"""
CARRIED_STEP = 0.34
"""iterations: A step by carried slopes counts as at least this part of an iteration.
budget of work: at most three such steps for one"""
CARRIED_VALUES = 400_000
"""values: One fit carries at most so many values of slopes along. budget of work: 3 MB"""
MIN_BLOCKS = 12
"""blocks: A log is cut into at least so many blocks for the held-out error.
principle: enough blocks to tell a gain that is everywhere from one lucky stretch"""
USUAL_BLOCKS = 24
"""blocks: A log of a subsystem of unknown memory is cut into so many blocks. principle: twice the least number"""
MOST_BLOCKS = 60
"""blocks: A log is cut into at most so many blocks. budget of work: each block has its normal matrix"""
MAX_SETS = 64
"""sets: One call of a model simulates at most so many sets of parameters.
budget of work: memory; answers are the same"""
MAX_VALUES = 8_000_000
"""values: Several fits hold at most so many errors at one time. budget of work: 64 MB; answers are the same"""
DIFFERENCE = 1e-3
"""scales: A numerical derivative moves a parameter by this part of its scale.
numerics: quantised outputs need steps this large"""
NO_ANSWER_ERROR = 1e6
"""noise floors: The error of a sample of which the model says nothing counts as so many noise floors.
numerics: no fit ends there, and squares stay finite"""
KEPT_ERRORS = 4_000_000
"""values: The latest simulations keep at most so many errors. budget of work: 32 MB"""
KEPT_SLOPES = 2_000_000
"""values: The latest linearisations keep at most so many slopes. budget of work: 16 MB"""

# ---- Noise ----------------------------------------------------------------------------------------------------------
FLOOR_KNOWN = 0.01
"""share: A noise floor that was estimated from a log is known to this relative error.
benchmark: clean logs stand within 1 % of the estimated floor"""
NOISE_KNOWN_TO = 0.05
"""share: Two estimates of one noise differ by up to this share on a clean log of some 100 s. benchmark: clean logs"""
RASTER_KNOWN_TO = 0.5
"""share: What a log's raster hides is known to this share: half the rows, or draws of what was not logged, tell it.
benchmark: clean logs of ordinary loggers, in the worst of their bins"""
PIECE_BLOCKS = 6
"""blocks: Each piece of an hours-long log has so many blocks, and fails only if it does so without its worst, too.
judgement: few enough that each holds many samples"""

# ---- Candidates -----------------------------------------------------------------------------------------------------
FORM_STEPS = 30
"""steps: The fit of a closed form to a curve takes at most so many steps from one start.
budget of work: bounds the fit of each form"""
FORM_DAMPING = 1.0
"""1: The fit of a closed form starts with this damping.
numerics: usual choice of the Levenberg-Marquardt method for scaled slopes"""
FORM_DIFFERENCE = 1e-7
"""1: The slopes of a closed form are differences over this step.
numerics: near the square root of the rounding of a double"""
FORM_ENOUGH = 1e-8
"""share: The fit of a closed form stops where a step gains no more than this share of the error.
numerics: near the square root of the rounding of a double"""
TRIED_SIZES = (0.01, 0.05, 0.2, 0.6)
"""usual sizes: The screening tries each library law at these parts of its place's usual size.
judgement: from hardly seen to gross"""
CURVE_SPLINES = 10
"""splines: A curve is made of so many cubic B-splines. judgement: the prior of the bending decides how many count"""
LEAST_SPLINES = 5
"""splines: A curve needs at least so many splines. principle: with fewer cubic B-splines it could hardly bend"""
LEAST_KNOT_DISTANCE = 1e-3
"""ranges: Two knots of a curve stand at least this part of its range apart.
numerics: closer knots make the basis ill-conditioned"""
LEVEL_SPREAD = 3.0
"""usual sizes: The prior of a curve's mean and slope has this standard deviation.
principle: wide against the usual size, so that the log decides"""
HARMONICS = 3
"""waves: A curve that repeats itself has so many harmonics. principle: form of a smooth periodic force"""
FINE_HARMONICS = 10
"""waves: A curve that repeats itself, and must be finer, has so many harmonics.
judgement: as many as a curve has splines"""
WAVE_SPLINES = 9
"""splines: Each wave of a periodic curve is made of so many splines.
numerics: so many cubic splines follow a sine closely"""
EDGE_SHARE = 0.001
"""share: This share of the visited values at each end may lie apart from the others.
judgement: single samples shall not stretch a curve"""
STRAY_RANGE = 0.25
"""ranges: The first and the last knot stand no further than this part of the others' range away from them.
judgement: goes with EDGE_SHARE"""

# ---- Selection ------------------------------------------------------------------------------------------------------
ONSET_BLOCKS = 2
"""blocks: Effects begin within a log where so many blocks before it are at the noise; so many lie behind it.
principle: a gain is no gain where a single block has it"""
ONSET_ROUNDS = 4
"""rounds: Effects that begin, and the time at which they do, are found in turn, at most so often.
budget of work: the time moves by samples after the second round"""
NINETY_ONSET = 5.94
"""noise floors squared: The interval of an onset holds all that leave so much more of the sum of squares than the best.
principle: nine in ten by Hansen (2000); a likelihood ratio below x has probability (1 - exp(-x / 2))^2"""
NATS = 12.0
"""log-likelihood: An effect must raise the log-likelihood by more than this.
benchmark: the best useless effect of the library stays below in 99 of 100 clean logs, with margin"""
SPREADS = 3.0
"""standard deviations: The whole log's RMS error must fall by so many standard deviations of it.
principle: the usual definition of detectable, three standard deviations"""
BLOCK_SPREADS = 8.0
"""standard deviations: The two best blocks' mean fall must exceed so many standard deviations, where an effect shows in
few blocks only.
principle: many blocks are looked at, so more than SPREADS"""
RIVAL_NATS = 3.0
"""log-likelihood: One of two accepted effects must lead by this log-likelihood to beat the other.
principle: odds of 20 to 1"""
RIVAL_SPREADS = 0.3
"""standard deviations: One of two accepted effects must have the smaller error by so many standard deviations to beat
the other.
benchmark: more than useless effects gain by errors of form on clean logs"""
CREDIBLE = 0.9
"""probability: An effect and its rivals must have at least this weight together. principle: 90 % credible set"""
RIVAL_SHARE = 0.25
"""share: One of two accepted effects must lead by this share of what it leaves above the floor itself.
judgement: the library's equations are not nature's"""
TOLERATED = 1.05
"""noise floors: Nothing is missing any more where the error is at most so many noise floors.
principle: as FLOOR_KNOWN, after the search"""
LEAST_SHARE = 0.15
"""share: A further effect must explain this share of the excess over the floor, and a named set may leave as much.
judgement: less is one effect correcting another's equation (docs/decisions/diagnosis_acceptance.md)"""
EXPLAINED = 0.5
"""share: All effects named in a subsystem must explain this share of the excess over the floor together.
judgement: a name that leaves most of the error is none"""
LEFT_FLOORS = 3.0
"""noise floors: A model with one effect may leave so many noise floors; the excess is divided by the number of effects.
judgement: each further effect is one more chance to imitate (docs/decisions/diagnosis_acceptance.md)"""
LEAST_FALL = 0.20
"""share: An effect must lower the held-out sum of squares beyond noise by this share.
judgement: 10 % of the RMS, far above the noise"""
LEAST_OF_NOISE = 0.10
"""share: An effect must lower the held-out sum of squares by this share of the noise's.
principle: the level of the noise is known no better (5 % of its RMS)"""
FORM = 0.02
"""share: An effect must lower the error by as much as an error of form of this share of the bare model's RMS makes.
principle: no equation of friction or flow is known better"""
LEAST_HELP = 0.75
"""share: This share of the summed changes of log error over the blocks must be improvement.
judgement: three quarters, so that no single block decides"""
AGREE = 0.05
"""log mean square: Two blocks at least must improve by this. judgement: 5 % of the mean square"""
AGREEING_BLOCKS = 2.0
"""blocks: So many blocks must improve. principle: one block alone may hold a disturbance"""
FLAT = 0.1
"""share: A block with less than this share of the log's error counts as perfect.
numerics: a logarithm of next to nothing would decide alone"""
PER_PARAMETER = 0.01
"""log error: A parameter costs this where sets of effects are compared. judgement: a fifth of RIVAL"""
RIVAL = 0.05
"""log error: Two candidates do equally well within this. judgement: validation logs then decide between them"""
BETTER = 0.02
"""log error: One candidate must be better by this to be exchanged for another.
judgement: worth of two parameters (PER_PARAMETER)"""
HARM = 0.10
"""log error: A validation log may get worse by no more than this. judgement: twice RIVAL"""
LEAST_USE = 0.02
"""log error: Some log must get better by at least this. judgement: as BETTER"""
UNKNOWN = 1.25
"""noise RMS: What is left is no noise where it exceeds the most noise that the samples can hold so many times.
judgement: 25 % above what noise can be"""
MOST_LEFT = 0.25
"""share: A named set may leave no more than this share of the sum of squares beyond noise.
judgement: what does not halve the RMS is not the answer (docs/decisions/diagnosis_own_models.md)"""
STRUCTURE = 0.25
"""share: What is left is called unknown physics where the logged channels predict this share of it.
judgement: as MOST_LEFT"""
LIKELY = 0.5
"""probability: A name in a subsystem that fails with it must be at least so probable, together with its rivals.
principle: more probable than not"""
TRUST_COEFFICIENTS = {"noise_floor": (-0.46, -0.75, 1.44, 0.23), "error_share": (0.57, -0.93, 1.23, 0.23)}
"""log odds: They weigh 1, error left, fall and share of a name.
benchmark: Platt scaling, 140 of 184 names of hidden_effect, 156 from ordinary loggers; 73 of 117 of hidden_law"""
TRUST_MOST_LEFT = 100.0
"""noise floors: An error left beyond this counts as this in the probability of a name.
benchmark: blind answers have shown no more"""
TRUST_MOST_FALL = 30.0
"""times: A fall of the error beyond this counts as this in the probability of a name.
benchmark: blind answers have shown no more"""
LONG_SAMPLES = 60_000
"""samples: A subsystem with at least so many is searched on an excerpt. budget of work: minutes for a diagnosis"""
EXCERPT_SAMPLES = 40_000
"""samples: The excerpt of a long log has about so many. budget of work: minutes for a diagnosis"""
EXCERPT_PIECE = 4_000
"""samples: An excerpt of a long log is made of pieces of so many in a row.
principle: longer than the memory of any subsystem here"""
PAIR_LEADERS = 2
"""effects: Pairs are tried from so many leading effects, where those found leave more than noise.
budget of work: the pairs of all leaders would be tried else"""
SCREEN_LINE = (0.02, 5.0)
"""times: A better size is looked for between these parts of the size tried.
principle: the linearisation holds near the size that was simulated"""
SCREEN_TOGETHER = 16
"""sets: The slopes of so many sets are simulated at one time. budget of work: memory; answers are the same"""
SAME_SIZE = (0.8, 1.25)
"""times: Sizes between these parts of another count as that size. budget of work: no start is fitted twice"""
STARTS_TOGETHER = 32
"""starts: So many starts are simulated at one time. budget of work: memory; answers are the same"""
DIRECTIONS = 12
"""starts: A fit of an effect with a direction may start from so many.
budget of work: more starts give the same answer (tests/test_directions.py)"""
AHEAD_SAMPLES = 8_000
"""samples: The excerpt that is searched ahead of a whole log has about so many.
budget of work: what is found on it is fitted to the whole log"""
LITTLE_TOLD = 0.5
"""share: A piece says little where it has less than this share of what counts in the best piece.
judgement: half of the excerpt must be worth its place"""
SHORT_PIECE = 500
"""samples: The smaller excerpt is made of pieces of so many in a row.
judgement: many short pieces are more like the log than few long ones"""
FITTED_ALONE = 12
"""effects: So many are fitted alone to the whole log after the excerpt was searched.
budget of work: those that promise most"""
FITTED_BESIDE = 8
"""effects: So many are fitted beside others to the whole log after the excerpt was searched.
budget of work: those that promise most"""
LEAST_PROMISE = 0.5
"""share: An effect must promise this share of the gain that it needs (NATS), or it is not fitted.
budget of work: half, for a linearised gain is rough"""
SIZES_AGREE = 0.5
"""share: A subsystem may be wrong about the size of an effect that another subsystem sees too by this share of it.
judgement: both name the effect, each with its own error of form"""
LOOK_EVERY = 0.1
"""s: Searches in other processes are looked at after each such time.
budget of work: costs nothing and is seen at once"""
SHORT_SEARCH = 10
"""times: A search that is so many times smaller than the longest takes next to nothing.
budget of work: it needs no process of its own"""
USUAL_FITS = 60.0
"""fits: Half of a subsystem's search is usually done after so many. judgement: scales the progress shown, no answer"""

# ---- Regimes --------------------------------------------------------------------------------------------------------
AGREES = 1.1
"""noise floors: An error of up to so many counts as noise.
principle: floors are known to some per cent; hil/figures.py has the same number"""
COLOUR = (2.0, 5.0)
"""samples: Of noise at least, and at most, so many samples count as one.
benchmark: what clean logs show of any subsystem"""
REGIME_BINS = 8
"""bins: The residuals are divided by a condition into so many of equal population.
judgement: as fine as a log of a minute allows"""
CONDITION_BAND = 4.0
"""standard deviations: A condition moves when its channel leaves a band of so many standard deviations of its noise to
each side.
principle: noise alone leaves it once in 16,000 samples"""
REGIME_LEVEL = 0.01
"""probability: Any bin of any condition is called significant by this chance when nothing is missing.
principle: test at 1 %, divided by the number of bins (Bonferroni)"""
SHAPE_TOLD = 0.2
"""share: What is left is described as a function of a condition where that explains at least this share of it.
judgement: a curve that leaves four fifths unexplained describes something else"""

# ---- Unmodelled terms -----------------------------------------------------------------------------------------------
FORMS_ALIKE = 1e-4
"""share: Two formulas are alike where they differ by less than this share of the curve's variance.
judgement: 1 % of the RMS, which no log shows"""
FORMS_REFITTED = 5
"""formulas: So many are fitted in the simulation in a curve's place. budget of work: the nearest ones"""
FORMS_NEAR = 0.05
"""share: A formula whose error is larger than the best one's by up to this share is still given. judgement: as RIVAL"""
FORM_POOR = 1.5
"""times: A formula with an error of more than so many times the curve's own is not the curve.
judgement: half more error is another shape"""
FORM_SHAPED = 0.2
"""share: A formula is fitted in the simulation only where it leaves no more than this share of the curve's variance.
budget of work: others are not its shape"""
FORM_FAR = 100.0
"""curve ranges: A formula's range may be so many times its curve's.
judgement: what goes so far is not the curve's shape"""
FORM_SAME = 0.02
"""share: A formula is given beside a simpler one only where it differs from it by this share of its spread.
judgement: less is the same curve in more words"""
FORM_MEAN_VALUES = 2_000
"""values: The mean of a formula is taken over so many of a quantity.
budget of work: the mean is known to 2 % of the spread"""
FORM_NOTHING = 1e-200
"""1: A formula says nothing where its RMS over the logs is below this. numerics: its square is still a double"""
FORM_STEEPER = 10.0
"""times: A formula runs away where it is so many times as steep as anywhere in the logs.
judgement: the logs say nothing of it there"""
PER_NUMBER = 0.005
"""log error: A number of a formula costs this where formulas are compared.
judgement: half of PER_PARAMETER, for the curve itself was accepted already"""
OTHER_AMPLITUDE = 1.5
"""times: Two swings have different amplitudes where one is so many times as large.
principle: a hysteresis and a lag differ in how they follow the amplitude"""
TIME_SPLINES = 24
"""splines: A curve over time has so many. judgement: what swings with time does so often"""
FINER_SLOPES = 0.025
"""scales: The slopes of a model's own parameters are taken over this part of their scale beside a curve.
numerics: a curve follows the model closer, where slopes change sooner"""
JUMP_SIDES = 0.05
"""share: A curve may jump where its quantity is 0 if it has this share of its values to each side.
principle: a jump needs data on both sides"""
LEAST_SETTLED = 0.5
"""share: This share of the samples must be left where those that remember what was before the log are not counted.
judgement: most of the log must count"""
SURELY = 3.0
"""standard errors: A sum over blocks is surely positive beyond so many.
principle: three standard deviations, as SPREADS"""
BAND_DRAWS = 400
"""draws: The band of a curve is made of so many. principle: quantiles of 5 % are then known to 1 %"""
BAND = 0.90
"""probability: The band of a curve contains this share of the drawn curves as a whole.
principle: 90 %, as all intervals"""
VISITED_BINS = 24
"""bins: A learned law reports how often its quantity was in each of so many bins. judgement: as fine as a page shows"""
SHOWN_PLACES = 9
"""places: The JSON of a learned surface has so many each way. judgement: as many as of its curve"""
SHOWN_SAMPLES = 1_000
"""samples: A page shows so many places where the logs have been. budget of work: size of a page"""
MOST_CURVES = 2
"""curves: A learned model has at most so many.
judgement: a third would be fitted to what the first two leave of their form"""
SCREENED_BEND = 1.0
"""usual sizes: Candidates are screened with this standard deviation of a curve's first bend.
judgement: the middle of BENDS_TRIED"""
BENDS_TRIED = (0.1, SCREENED_BEND, 5.0)
"""usual sizes: A curve is fitted with each of these standard deviations of its first bend.
principle: the held-out error chooses the prior (empirical Bayes)"""
CURVES_QUICK = 24
"""candidates: So many curves are fitted for a few steps. budget of work: those that the ranking promises most"""
CURVES_FINISHED = 5
"""candidates: So many curves are fitted to the end. budget of work: those that do best after a few steps"""
FEW_STEPS = 3
"""steps: A quick fit of a curve takes so many. budget of work: on an excerpt more would only suit the excerpt"""
MANY_STEPS = 12
"""steps: A quick fit of a curve takes so many where the model is far off.
budget of work: the right place has a crooked way to go"""
FAR_OFF = 5.0
"""noise floors: A model is far off where it leaves more than so many.
judgement: the linearisation does not hold there"""
SURE_BY_HELD_OUT = 3
"""candidates: So many of the finished curves are chosen by data left out alone.
judgement: the others may be chosen by place"""
MOST_HYSTERESES = 2
"""candidates: So many hystereses are fitted to the end, whatever data left out say.
judgement: what promises most hardly distinguishes crank and rings"""
MOST_OVER_TIME = 2
"""candidates: So many of the finished curves may be over time. judgement: with its many splines time imitates much"""
MOST_PLAINER = 2
"""candidates: So many more are fitted to the end where they are plainer than the best, and as many at their place
itself.
budget of work: the preference needs them"""
MAY_CATCH_UP = 0.25
"""log error: A candidate within this of the best after its first fit may still do as well.
judgement: longer fits and finer splines may change as much"""
LAG_TIMES = (1.8, 1.3, 1.1, 1.03)
"""times: A lag is changed by these factors, one after the other.
numerics: search of one parameter by ever smaller steps"""
LEAST_LAG_GAIN = 0.002
"""log error: A change of a lag or a period must help by this. budget of work: smaller changes decide nothing"""
PERIOD_TURNS = (0.3, 0.1)
"""turns: A period is changed by these over the whole way, one after the other.
numerics: half a turn would lose the phase"""
FORMULAS_WITHIN = 0.5
"""log error: Formulas and jumps are tried in a curve that is worse than the best by up to this.
judgement: they may still tell it better"""
FINE_SPLINES = 28
"""splines: The best finished curves have so many where they still fail.
budget of work: some three times CURVE_SPLINES"""
FORMULA_MAY_EARN = 0.25
"""log error: A curve within this of the best that is not accepted may be accepted by its closed form.
judgement: a formula has fewer parameters"""
NOT_INSTEAD = 0.5
"""log error: What degrades no validation log does not replace what does where it is worse than the best by this.
judgement: ten times RIVAL"""
LEAST_PARAMETER_LEFT = 0.1
"""share: A parameter must keep this share of itself when a formula takes its mean back.
judgement: a formula shall not take a parameter's place"""
TABLE_POINTS = 33
"""points: A table in a written Python file has so many each way.
judgement: three to a spline, interpolated below the band"""
LAW_TEST_VALUES = 9
"""values: The test in a written Python file of a curve holds so many. judgement: one near each spline"""
SURFACE_TEST_VALUES = 4
"""values: The test in a written Python file of a surface holds so many each way. judgement: one near each spline"""
LAG_PLACES = (1.0 / 6.0, 1.0 / 2.0, 5.0 / 6.0)
"""share: Lags are tried at these parts of the way, in logarithms, from the shortest to the longest.
principle: centres of three equal parts"""
SHORTEST_LAG = 3.0
"""samples: The shortest lag tried is so many long. principle: a shorter one cannot be distinguished from none"""
LONGEST_LAG = 0.125
"""log lengths: The longest lag tried is this part of the shortest log.
principle: a longer one cannot be distinguished from an integral"""
MOST_DIFFERENCES = 2
"""differences: A state or input has at most so many as candidates.
budget of work: a chain of n has n - 1 links, and n to what is about it"""
NOISY_DIFFERENCE = 0.1
"""share: A difference is no candidate where noise may be more than this share of its spread.
judgement: noise in a regressor biases its curve towards nothing"""
SAME_EQUATION = 32
"""draws: An output is an acceleration that follows a model's derivative through so many changes of states and
parameters.
principle: equations that agree at so many random points are the same"""
DERIVATIVE_PLACES = 5
"""places: The model's derivatives are looked at in so many.
budget of work: a term that acts nowhere among them is rare"""
DERIVATIVE_STEP = 1e-3
"""spreads: The model's derivatives are differences over this part of a channel's spread.
numerics: between rounding and curvature"""
SCREEN_STEPS = 8
"""steps: A candidate that is too crooked for one step is fitted for so many. budget of work: ranking only"""
PERIODS_OFF = (0.0, -0.25, 0.25)
"""turns: A period along a channel is tried off by these over the whole way.
principle: a line is known to half a turn"""
PROBE_SIZE = 1e-2
"""usual sizes: A place is moved by this constant to see what a swing there would do.
numerics: between rounding and curvature"""
MOST_CROOKED = 24
"""candidates: So many of those that are too crooked for one step are fitted.
budget of work: those that are promised most"""
SCREEN_DAMPING = (0.003, 0.03, 0.3)
"""1: A candidate's step is simulated with these parts of the diagonal of its normal equations added.
numerics: Levenberg-Marquardt damping, a factor of ten apart"""
MOST_PERIODS = 2
"""periods: So many of one place are tried. budget of work: the clearest lines"""
CLEAR_LINE = 40.0
"""median powers: A line is one where it has so many times the median power about it.
principle: the highest of 100,000 lines of white noise has 17 times the median"""
CLEAR_COMB = 15.0
"""median powers: Three harmonics are a comb where they have so many times the median power about them.
principle: noise has 6.5 times the median"""
ABOUT_LINES = 50
"""lines: The median power about a line is taken over so many each way.
judgement: enough for a median, near enough for coloured noise"""
LEAST_CYCLES = 6.0
"""cycles: A log must contain at least so many of a period. principle: fewer cannot be distinguished from drift"""
SAMPLES_PER_PERIOD = 2.5
"""samples: A period must have at least so many. principle: two are the sampling theorem's limit"""
MODEL_ORDERS = 6
"""multiples: So many of a line that drives the model are the model's own. judgement: harmonics of its curves"""
DRIVEN_SHARE = 0.01
"""share: A line drives the model where it has this share of the variance of an input. judgement: 10 % of the RMS"""
DRIVEN_MAIN = 0.2
"""share: A line is most of what drives the model where it has this share of the variance of an input.
judgement: its multiples are then the model's own"""
REPEATED = 0.9
"""correlation: What drives the model is repeated where it correlates with itself a while later by this.
judgement: 80 % of the variance in common"""
LOGS_ALIKE = 0.9
"""share: A line is the same in each log where they have this share of its power together.
judgement: the rest is noise"""
LINE_PIECES = 5
"""pieces: A log is cut into so many to see whether a line is steady.
judgement: a line of LEAST_CYCLES has a cycle in each"""
STEADY_LINE = 0.7
"""share: A line is steady where the pieces have this share of its power together. principle: a sine has 1, noise 0.2"""
MOSTLY = 0.5
"""share: A line that takes this share off the sum of squares may be all that is missing, whatever is about it.
judgement: more than half"""
LINE_RESOLVED = 0.5
"""lines: Two frequencies that are nearer than this are not distinguished.
principle: resolution of a spectrum of that length"""
LINES_EACH = 4
"""lines: A spectrum has so many for each that its length resolves.
numerics: zero padding, so that a peak between two lines is seen"""
LINE_DERIVATIVES = 2
"""derivatives: The swings of a channel's period are looked for in what up to so many do.
principle: a force acts through acceleration and speed"""
UNEVEN_PERIODS = 0.5
"""periods: A channel must leave a straight course in time by this, so that a period along it is not one in time.
principle: half a period is the largest difference of phase"""
CYCLE_BINS = 4
"""bins: A channel has so many for each of the finest cycles that are looked for.
numerics: loses less than a fifth of a cycle's power"""
SURFACE_SPLINES = 5
"""splines: A surface has so many of each quantity. budget of work: their products are fitted"""
PRODUCT_TURNS = 60
"""iterations: The two factors of a product are found by so many at most. budget of work: alternating least squares"""
PRODUCT_FORMS = 4
"""formulas: So many of each quantity are tried in a product. budget of work: the nearest ones"""
PRODUCTS_REFITTED = 8
"""pairs: So many pairs of formulas are fitted in the simulation. budget of work: the nearest ones"""
SURFACE_QUANTITIES = 5
"""quantities: Pairs for surfaces are made of so many. budget of work: ten pairs"""
SURFACES_TRIED = 48
"""candidates: So many surfaces are fitted for one step. budget of work: the most promising pairs at all places"""
SURFACES_QUICK = 10
"""candidates: So many surfaces are fitted for a few steps. budget of work: those that do best after one"""
SURFACES_FINISHED = 4
"""candidates: So many surfaces are fitted to the end. budget of work: those that do best after a few"""
FINE_SURFACE_SPLINES = SURFACE_SPLINES + 1
"""splines: A surface has so many each way where the best still fails. budget of work: one more than SURFACE_SPLINES"""
SURFACE_BENDS_TRIED = (0.03, 0.1, 0.3, SCREENED_BEND, 5.0)
"""usual sizes: A surface is fitted with each of these standard deviations of its first bend.
principle: as BENDS_TRIED, in smaller steps"""

# ---- User models ----------------------------------------------------------------------------------------------------
WIDE = 4.0
"""sizes: A parameter that the user calls unknown may move this far each way in later fits.
judgement: wide, so that the log decides"""
GIVEN = 12.0
"""values: A value that the user gave may move this far each way in later fits, in itself.
principle: it may be wrong by a factor of ten"""
SLIGHT = 0.3
"""spreads: A small step may move an output by this part of its spread. numerics: the linearisation holds"""
MOST_SHRUNK = 8
"""tries: So many ever smaller steps are tried to find a small one. budget of work: to 1/256 and less"""
START_DRAWS = 3
"""draws: A model starts from so many of the noise to see what noise in its start does.
budget of work: each is a simulation"""
START_FORGOTTEN = 0.2
"""noise RMS: A start that a reading's noise moves an output by less than this is not fitted.
principle: it then adds 2 % to the RMS"""
START_STEP = 0.1
"""noise RMS: A start is moved by this to see what it does. numerics: small against the noise"""
START_WITHIN = 3.0
"""noise RMS: A start may be this far from its reading. principle: three standard deviations"""
FACTOR = 10.0
"""times: A value that the user gave may be wrong by this factor. judgement: an order of magnitude"""
MOST_DRAWN = 7
"""powers of two: At most two to this power sets of starting values are drawn, by the number of unknown parameters.
budget of work: 128 simulations"""
START_WINDOWS = 60
"""windows: A log is cut into so many to fit starting values to. budget of work: short simulations hardly diverge"""
LEAST_WINDOW = 10
"""samples: A window has at least so many. principle: more than a model's unknown starts"""
FITS_FROM = 4
"""sets: A fit begins from so many drawn sets of values beside the user's own. budget of work: the best of MOST_DRAWN"""
START_STEPS = 16
"""steps: A fit of starting values takes at most so many. budget of work: what comes after goes on from there"""
MOST_SAMPLES = 12_000
"""samples: The search looks at about so many of a longer log. budget of work: what it finds is judged on all of them"""
LEAST_QUANTUM = 1.0
"""noise RMS: A quantisation is looked for with steps of at least this.
principle: a smaller step makes an error of less than 0.3 of the noise"""
QUANTUM_FREQUENCIES = 6000
"""frequencies: So many steps of a quantisation are looked at. budget of work: seconds"""
QUANTUM_SAMPLES = 3000
"""samples: A quantisation is looked for in so many. budget of work: seconds"""
QUANTUM_PEAKS = 3
"""peaks: So many of each kind are kept as starts for a quantisation. budget of work: each is fitted"""
QUANTUM_FINER = 16.0
"""frequencies: So many to one turn of the phase are tried around a peak.
numerics: the peak is found to a sixteenth of a turn"""
QUANTUM_MOST_FINER = 500
"""frequencies: At most so many are tried around a peak. budget of work: seconds"""
NO_HELP = 0.85
"""times: A law hardly helps a log where the error with it over that without it exceeds this.
judgement: 15 % is what noise and form may do"""
BOUND_PULL = 0.01
"""share: A log asks for a parameter beyond its bound where this would take this share off the squared error.
judgement: 1 % of the power is seen in a log"""
DRIVES = -0.05
"""RMS powers: A measured force drives a machine where its mean power is below this, in RMS force times RMS velocity.
principle: what is driven takes some; the sign stands out from noise"""
MOVES = 0.3
"""RMS: A velocity at the start of a log is reported where it exceeds this. judgement: a third of what is usual"""
EDGE_PERIODS = 2.0
"""periods: So many of the cut-off do not count at each end of a differentiated log. principle: a filter's transient"""
SPLINE_MEMORY = 8
"""samples: A derivative by splines forgets the end of a log after so many.
principle: 0.27^8 of the error there is left"""
UNORDERED = 1.0
"""variances: Rows of a static model stand in no order where each input's mean squared step from row to row is more than
this.
principle: von Neumann's ratio is 2 for rows in random order, near 0 for a run"""
MOST_PLANES = 1000
"""rows: The noise of rows in no order is told from planes through so many of them and their neighbours.
budget of work: the median of so many is known to 2 %"""
PLANE_FREE = 5
"""rows: A plane through a row and its neighbours has so many more rows than it has parameters.
judgement: the fewer, the nearer they are"""
LONGEST_SPIKE = 3
"""samples: A spike lasts no longer than this. judgement: what stays away for longer is no spike"""
SPIKE_FAR = 10.0
"""usual distances: A spike stands so far off the line between its neighbours.
judgement: ten times what all but 3 % of the samples stay within"""
SPIKE_BACK = 0.1
"""share: The samples after a spike come back to this part of its jump. judgement: what does not come back is a step"""
INPUT_JUMP = 5.0
"""usual steps: An input jumps where it moves so many times what is usual from sample to sample.
judgement: a spike beside it may be its answer"""
SPIKE_ANSWERS = 0.25
"""share: Spikes answer an input where this share of its jumps has one beside it. judgement: more than chance"""
SPIKE_SHARE = 0.005
"""share: Spikes are no more than this of the samples. judgement: what is away more often is how the machine is"""
COARSE_STOPS = 5
"""stops: A hysteresis curve is judged by so many. numerics: its second derivative is mostly noise"""
BEFORE_LOG = 0.05
"""share: This share of a hysteresis's height may be of what was before the log. judgement: as RIVAL"""
NO_TURN = 0.02
"""share: A channel may go back by this share of its whole way without having turned.
judgement: noise and hunting are no reversal"""
NEGATIVE_STOPS = 0.2
"""share: This share of the stops' weights may be negative. judgement: noise makes some; a hysteresis has none"""
RUN_AWAY = 1e50
"""1: A simulated value beyond this is no size of anything. numerics: the numbers of laws made from it stay finite"""
CURVE_BOUND = 1e3
"""usual sizes: A curve's values stay within this. numerics: a bound that no fit meets"""
FORCE_SHARE = 0.9995
"""share: Forces are compared up to the frequency below which this share of the measured force's power lies.
judgement: 2 % of the RMS lies above"""
FLAT_TO = 3.0
"""times: Motion is differentiated up to so many times the frequency to which forces are compared.
principle: what is compared passes the low-pass whole"""
SPECTRUM_PARTS = 20
"""parts: A spectrum is cut into so many, of which the quieter quarter is its white noise.
judgement: enough for a quantile"""
ABOVE_WHITE = 2.0
"""standard deviations: The power above a frequency may exceed that of white noise by so many.
principle: two standard deviations"""
SHORT_RUN = 10_000
"""steps: Simulations of fewer steps get no thread of their own. budget of work: it costs more than it gains"""
SWITCHED = 4
"""steps: At least so many are made between two samples where something sticks, slips or stops.
numerics: the time of a switch is known to a quarter of a sample"""
SPLINE_SAMPLES = 4
"""samples: A cubic spline needs so many. numerics: four coefficients"""
STARTS_LOADED = 5.0
"""noise RMS: The springs carry a measured force above this at the start of a log.
principle: beyond all noise, five standard deviations"""
AT_ONCE = 1e-3
"""ranges: A jump is a straight line within this part of the range of what is simulated and is no state's speed.
numerics: an integrator does not meet a jump"""
LEAST_SAMPLES = 50
"""samples: A log of a model of your own has at least so many. judgement: a dozen parameters need some for each"""
LEAST_POINTS = 12
"""points: A log of steady points has at least so many, which need no neighbours in time.
judgement: a curve of four numbers, three times over"""
DESIGN_SAMPLES = 4000
"""samples: A proposed run is simulated with so many samples at most. numerics: a second for each run tried"""
DESIGN_SIZES = (1.0, 0.7, 0.5, 0.3, 0.15)
"""share: A run takes the first of these parts of its range with which its outputs keep their limits.
judgement: the larger the more it tells"""
DESIGN_PARTS = 24
"""parts: The best run is improved by shifting one of so many parts of it. judgement: what a bench can follow"""
DESIGN_SHIFTS = 60
"""runs: So many shifts of a part are tried. judgement: each takes as long as a run of the bank"""
DESIGN_GAIN = 1e-3
"""log error: A shift must tell so much more. numerics: less is rounding"""
DESIGN_PACE = 0.618
"""times: Each further input goes through a run so much faster. numerics: no two inputs then go together"""
DESIGN_CHECKS = 4
"""runs: A proposed run is simulated with so many draws of noise. judgement: with either rival as the truth"""

# ---- Vane chain -----------------------------------------------------------------------------------------------------
NEAR_STOP = 0.3
"""mm: A piston rests on its stop within this. judgement: a stop is known no better"""
SIMPLER_LINKAGE = 2e-3
"""deg: The simpler model of a linkage, with one play a ring, leaves this of one with several pins.
benchmark: simulated logs without noise leave 0.0011 to 0.0022"""
SIMPLER = {"hydraulic": 4e-4, "electromechanical": 1.1e-3}
"""mm: The simpler model of an actuator leaves this of one with mass, oil spring and bristles.
benchmark: simulated logs without noise leave 0.0004 (hydraulic), 0.0008 to 0.0015 (electromechanical)"""
QUICK_SAMPLES = 4_000
"""samples: The excerpt that ranks the candidates to fit has so many. budget of work: ranking only"""
LEARN_PIECE = 1_000
"""samples: The excerpt that is learned on is made of pieces of so many in a row.
judgement: longer than the memory of the subsystem"""
FREE_PIECE = 2_000
"""samples: The pieces of a subsystem that runs freely have so many. principle: it must find its state again in each"""
PROBED = 0.01
"""usual sizes: A place is moved by this part of a curve's usual size to see what that does.
numerics: between rounding and curvature"""
LAG_CHANGES = 0.01
"""spreads: A lag must change a channel by this part of its spread. judgement: less cannot be distinguished from none"""
CHAIN_MEMORY = 10.0
"""s: No subsystem of the vane chain remembers longer than this. physics: longer than its slowest lag"""
LEAST_FLOOR = {"demand": 2e-3, "servo": 1e-3, "engine": 1e-4, "actuator": 1e-4, "linkage": 1e-3}
"""border units: The noise floor of a subsystem is at least this. physics: no sensor measures finer"""
CURRENT_DRAWS = 8
"""draws: So many are made of the current that a log hides.
principle: the integral wanders, so that one draw says little of a stretch of the log"""
SMOOTH_ROWS = (9, 15, 25, 41)
"""rows: The stroke's noise may be smoothed over each of these. judgement: 90 to 410 ms"""
SMOOTH_ORDER = 3
"""degree: The stroke is smoothed by polynomials of this degree.
numerics: Savitzky-Golay filter that keeps velocity and acceleration"""
TRIANGLE_ROWS = 4_000
"""rows: One triangle of the feedback is made of so many at a time. budget of work: memory"""
SMOOTH_WINDOW = 1.0
"""s: What smoothing bends is distinguished from noise over this time. judgement: longer than a step of the servo"""
CURRENT_LAGS = (0.01, 0.03, 0.1)
"""s: The motion may trail the model's by a sum of these lags of valve and LVDT.
physics: lags of valve and LVDT, half a decade apart"""
FLOW_BENDS = (0.3, 0.6, 0.85, 0.97)
"""share: The curve of flow over opening may bend where these shares of the rows move less.
judgement: denser where the valve is open"""
WARM_FRAMES = 200
"""frames: The controller runs so many before the log. physics: it comes to RUN and its demand settles"""
APPROACH = 4.0
"""%: The demand comes from this far below and above in the frames before the log.
physics: more than the hysteresis of any schedule"""
DEMAND_SAME = 1e-6
"""m: Two demands that are nearer than this are the same.
physics: what the controller remembers from before the log makes no difference any more"""
MOST_REPEATS = 4
"""repeats: A profile is proposed with at most so many, where once does not decide.
judgement: minutes at a test bench"""
MARGIN = 2.0
"""times: A proposed profile must promise so many times what decides.
judgement: the machine is not the model, and its noise is another"""
EFFECT_SIZES = (0.003, 0.03, 0.2, 0.6)
"""share: The screening tries an effect at these parts of the way from neutral to its bound.
judgement: from hardly seen to gross"""
SHAPE_STARTS = {"speed": 5.0, "distance": 0.3, "spread": 0.6}
"""units of each: A second parameter of an effect starts at this. judgement: middle of what machines show"""
SHAPE_KNOWN = {"drag": 0.5}
"""share: A second parameter is known to this half-width of its neutral value. judgement: few logs show it by itself"""
EFFECT_FACTORS = (0.8, 0.95, 0.99, 1.01, 1.05, 1.25)
"""times: The screening tries an effect that multiplies at these factors. judgement: from hardly seen to gross"""
RASTER = 1e-2
"""s: Logs are resampled to this time base. physics: period of the controller's slow frames"""
WINDOW = 1.0
"""s: A subsystem that integrates is compared in windows of this length.
judgement: shorter than its drift, longer than a step"""
SUBSTEPS = 5
"""steps: The actuator makes so many between two samples. numerics: steps of 2 ms"""
SETTLE = 3.0
"""s: So much at the start of a log does not count. physics: filters, lags and backlash forget how they started"""
LATE = 0.04
"""s: Channels may stand early or late in the file by so much.
numerics: recorders that are started together, and their filters; beyond it a channel is another run's"""
OTHER_CURRENT = 0.9
"""share: A logged current is another kind of sample than the mean since the row before where it misfits by this much
less.
judgement: clearly better, while both hold the same noise"""
NOISE_ALIKE = 0.5
"""share: Noise has the power that is expected in each bin within this share of its excess, as two standard deviations.
judgement: physics that is missing shows little of its error somewhere: at rest, in one direction, at low speed"""
NOISE_BY_CHANCE = 0.05
"""share: Level of the test on all conditions; share of bins that may drift, and of power that parameters may take.
principle: the usual level of a test"""
NOISE_TOLD = 0.8
"""share: An error that stands in half of a condition's bins has to fail the test with this probability.
principle: the usual power of a test (Cohen 1988)"""
QUIET_KNOWN_TO = 2.0
"""times: The noise of a channel may be so many times how it moves in its quietest windows.
principle: noise as slow as a window is twice its deviation from a trend in there"""
NOISE_WINDOW = 4.0
"""s: The spectrum of a channel's noise is taken of windows of this length.
principle: noise that is slower has no place in it"""
LOW_PASS_ROWS = (0.3, 0.6, 1.0, 1.6)
"""rows: Delays from which the low-pass of a slow recorder is sought.
numerics: anti-alias filters of a tenth to a half of the rate, each within reach of the next"""
LOW_PASS_LASTS = 12.0
"""delays: After so many a low-pass has forgotten a value. principle: to a millionth"""
ROW_PARTS = 50
"""parts: A low-pass is worked out in so many parts of a row. principle: its error is below 1 %"""
NOISE_DRAWS = 4
"""draws: So many tell how much of the noise behind a low-pass a noise floor shows, and what noise does to a subsystem.
budget of work: the draws differ by some per cent"""
HUM_CHANCE = 1e-6
"""probability: Of a log without hum one of so many has a line taken out. principle: never by chance"""
HUM_NEARBY = 201
"""bins: A line stands out of the median of so many bins. judgement: the noise is even over so many"""
HUM_LINES = 4
"""lines: At most so many lines of hum are taken out. budget of work: the mains, harmonics"""
MOVES_ALIKE = 0.1
"""share: Fewer moved channels may explain so much less of the error than more of them.
judgement: the plainer of two readings of a recorder"""
