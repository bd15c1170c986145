//! What a run leaves, as one typed model: the learner writes it, and everything that shows, compares or goes on with runs
//! reads it through this crate.
//!
//! Two files hold it. `metrics.jsonl` has one JSON object a line: first whose file it is and how the run was made
//! ([`Header`]), then training and evaluations as they came ([`Line`]). `summary.json` says how the run ended ([`Summary`]).
//! [`Record`] is both together with the configuration, of a run directory or of a *committed record*: `NAME.jsonl` with
//! the header and the evaluations, and `NAME.json` with the summary. What `rit shapley` found ([`Shapley`]) lies beside
//! them: `shapley/TASK.json`, or `NAME.shapley-TASK.json`.
//!
//! Numbers that are no numbers are written as `null`, which JSON has, and read as NaN. Fields that this build does not know
//! are kept. The last line of a file may be torn, since its run may be alive or killed: it is the end of the file. Any
//! other line that cannot be read is left out and counted.

mod committed;
mod discover;
mod error;
mod header;
mod line;
mod lines;
mod machine;
mod measured;
mod number;
mod record;
mod results;
mod shapley;
mod summary;
mod sweep;

pub use committed::commit;
pub use discover::discover;
pub use error::RecordError;
pub use header::{Header, MeasureHelp, OtherFile, Run, is_header};
pub use line::{Evaluation, Line, Occasion, Progress, TrainingPoint};
pub use lines::{Lines, last_progress};
pub use machine::{Build, Host, cpu_seconds};
pub use measured::Measured;
pub use record::Record;
pub use results::{EachEpisode, Exploring, TaskResult, in_words};
pub use shapley::{Residual, Shapley, ShapleyEstimate, Symmetry};
pub use summary::{Best, Ended, Summary};
pub use sweep::{Cell, CellState, Sweep};
