//! What makes learners of networks: a batch cut into shards, threads that work on them, sums over them in a fixed tree,
//! objectives, one step of the optimiser; and acting.

mod acting;
mod by_utilities;
mod pairs;
pub(crate) mod shards;
pub mod td;
mod values;

pub use acting::ValueActing;
pub(crate) use by_utilities::ByUtilities;
pub use shards::{Sums, tree_sum, tree_sum_f64};
pub use td::{
    Head, Pass, Role, Said, SeenShard, TdLearner, TdPass, Totals, Utilities, ValueNetwork, ValueParts,
    measures,
};
