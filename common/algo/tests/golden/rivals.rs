//! What REFIL's and ROMA's cases hold beside those of other methods.

use super::{Cells, Tensors};
use rit_algo::{
    RoleConfig,
    methods::{refil::Groups, roma::RoleNoise},
};
use serde::Deserialize;

/// ROMA's keys of a case's configuration.
#[derive(Deserialize)]
pub struct Role {
    role_dim: usize,
    role_hidden_dim: usize,
    role_variance_floor: f32,
    role_entropy_weight: f32,
    role_kl_weight: f32,
    role_dissimilarity_weight: f32,
    role_soft_constraint: f32,
}

impl Role {
    pub fn config(&self) -> RoleConfig {
        RoleConfig {
            dim: self.role_dim,
            hidden_dim: self.role_hidden_dim,
            variance_floor: self.role_variance_floor,
            entropy_weight: self.role_entropy_weight,
            kl_weight: self.role_kl_weight,
            dissimilarity_weight: self.role_dissimilarity_weight,
            soft_constraint: self.role_soft_constraint,
        }
    }
}

/// Whether an expected tensor has a number for each ordered pair of agents.
pub fn of_pairs(name: &str) -> bool {
    matches!(name, "role_information" | "role_dissimilarity")
}

/// The groups of every real entity.
pub fn groups(batch: &Tensors, cells: &Cells) -> Groups {
    let groups = batch.f32("groups");
    let entities_max = groups.len() / cells.episodes();
    let of_episode = |(episode, entities): (usize, &Vec<usize>)| {
        entities.iter().map(|row| groups[episode * entities_max + row] as u8).collect()
    };
    cells.entities.iter().enumerate().map(of_episode).collect()
}

/// The noise of every real agent in every state up to the bootstrap state.
pub fn noise(batch: &Tensors, cells: &Cells, dim: usize) -> RoleNoise {
    let noise = ["role_noise", "target_role_noise"].map(|name| batch.f32(name));
    let agents_max = noise[0].len() / (cells.episodes() * (cells.steps_max + 1) * dim);
    let of_episode = |(episode, agents): (usize, &Vec<usize>)| {
        noise.each_ref().map(|noise| {
            let states = (0..=cells.steps[episode]).map(|time| episode * (cells.steps_max + 1) + time);
            let rows = states.flat_map(|state| agents.iter().map(move |agent| state * agents_max + agent));
            rows.flat_map(|row| noise[row * dim..(row + 1) * dim].to_vec()).collect()
        })
    };
    cells.agents.iter().enumerate().map(of_episode).collect()
}
