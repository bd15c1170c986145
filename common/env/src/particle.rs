//! The particle worlds: bodies with inertia that push each other apart on a plane without walls. After the
//! multi-agent particle environment of Lowe et al., "Multi-Agent Actor-Critic for Mixed
//! Cooperative-Competitive Environments" (2017), with the task sets of the paper's section VI-A.

mod cooperative_navigation;
mod predator_prey;
mod scripts;
mod world;

pub use cooperative_navigation::CooperativeNavigation;
pub use predator_prey::{PredatorPrey, PredatorPreyReward};
pub(crate) use scripts::{act_by_nearest_assignment, chase};
pub use world::DIRECTIONS;
