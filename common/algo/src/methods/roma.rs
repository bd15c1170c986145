//! ROMA: every agent draws a role from what it sees, and its role generates the last layer of its utilities.

mod losses;

use crate::{
    ModelConfig, RoleConfig, Rows,
    blocks::{Encoder, GaussianHead, Mixer, NormalVars},
    drive::{Head, Pass, Role, Said, Sums, TdPass, Totals, Utilities, ValueNetwork, ValueParts, measures},
    learner::{Draw, Measure},
    method,
};
use losses::Dissimilarity;
use rit_episode::{Episode, Rng, Stream, Turn};
use rit_nn::{
    Generated, Gru, LayerNorm, Layout, LayoutBuilder, Linear, Tape, Var, View, attention::Visible,
    random::fill_standard_normal,
};

const MEASURES: [Measure; 9] = measures::measures(
    [
        Measure {
            name: "role_loss",
            help: "Role loss: softplus of the weighted role entropy and divergence",
        },
        Measure { name: "role_entropy", help: "Mean entropy of roles" },
        Measure { name: "role_kl", help: "Mean divergence of roles from their posterior" },
        Measure {
            name: "dissimilarity_loss",
            help: "Loss of roles that are neither informative nor dissimilar",
        },
    ],
    true,
);

/// The utility network with its roles, and all else in [`ValueParts`].
#[derive(Clone, Debug)]
pub struct Roma {
    parts: ValueParts,
    /// Whether an agent's own features stand beside its attention.
    beside: bool,
    encoder: Encoder,
    gru: Gru,
    /// l → r.
    role_hidden: Linear,
    role_norm: LayerNorm,
    /// h → A, by a layer that the role makes.
    head: Generated,
    role_encoder: Encoder,
    role: GaussianHead,
    /// The role as told from what the agent went through, for a loss alone.
    posterior: GaussianHead,
    dissimilarity: Dissimilarity,
    config: RoleConfig,
}

/// Standard normal numbers of each episode, `[T + 1, n, l]`, for the online and the target network's pass.
pub type RoleNoise = Vec<[Vec<f32>; 2]>;

/// What passes read beside rows.
#[derive(Debug, Default)]
pub struct RoleInputs {
    /// Noise of each agent row, (R, l): the online pass's or an acting one's, and the target's.
    noise: [Vec<f32>; 2],
    /// The ordered pairs of agents of each step that was taken, first and second.
    pairs: [Vec<usize>; 2],
}

/// What the online pass leaves for the losses. With R agent rows:
#[derive(Clone, Copy, Debug)]
pub struct Roles {
    /// (m, v), (R, l).
    role: NormalVars,
    /// ρ, (R, l).
    sample: Var,
    /// (m′, v′), (R, l).
    posterior: NormalVars,
}

impl Roma {
    /// Declares the networks: utility and role encoder, mixer, then what only losses need.
    pub fn new(config: &ModelConfig) -> Self {
        let (mut network, layout) = Layout::of(|layout| Self::declare(config, layout));
        network.parts.layout = layout;
        network
    }

    fn declare(config: &ModelConfig, layout: &mut LayoutBuilder) -> Self {
        let (h, a, d, roles) = (config.hidden_dim, config.attention_dim, config.entity_dim, config.role);
        let (l, r) = (roles.dim, roles.hidden_dim);
        let beside = config.encoder == method::Encoder::Beside;
        let width = if beside { h + a } else { a };
        let encoder = Encoder::new(layout, "utility", d, h, a, config.n_heads);
        let gru = Gru::new(layout, "utility.gru", width, h);
        let role_hidden = Linear::new(layout, "utility.role_hidden", l, r);
        let role_norm = LayerNorm::new(layout, "utility.role_norm", r);
        let weight = Linear::new(layout, "utility.head_weight", r, h * config.n_actions);
        let head = Generated::new(weight, Linear::new(layout, "utility.head_bias", r, config.n_actions));
        let role_encoder = Encoder::new(layout, "role_encoder", d, h, a, config.n_heads);
        let role = GaussianHead::new(layout, "role_encoder", width, r, l, roles.variance_floor);
        let acting = 0..layout.len();
        let of_mixer = Encoder::new(layout, "mixer", d, h, a, config.n_heads);
        let mixer = Mixer::new(layout, of_mixer, 0, config.mixing_embed_dim, config.hypernet_embed_dim);
        let target = 0..layout.len();
        let posterior = GaussianHead::new(layout, "role_posterior", h + width, r, l, roles.variance_floor);
        let dissimilarity = Dissimilarity::new(layout, l, r);
        let parts = ValueParts {
            layout: Layout::default(),
            acting,
            target,
            n_actions: config.n_actions,
            memory_dim: h,
            gru: true,
            mixer: Some(mixer),
            task: None,
        };
        Self {
            parts,
            beside,
            encoder,
            gru,
            role_hidden,
            role_norm,
            head,
            role_encoder,
            role,
            posterior,
            dissimilarity,
            config: roles,
        }
    }

    fn encode<'a>(&self, tape: &mut Tape<'a>, encoder: &Encoder, rows: &'a Rows) -> Var {
        if self.beside {
            encoder.beside(tape, rows)
        } else {
            encoder.within(tape, rows, &[Visible::Where(&rows.observable)])
        }
    }
}

/// So many standard normal numbers.
fn standard_normal(rng: &mut Rng, len: usize) -> Vec<f32> {
    let mut numbers = vec![0.0; len];
    fill_standard_normal(rng, &mut numbers);
    numbers
}

impl ValueNetwork for Roma {
    type Draws = RoleNoise;
    type Inputs = RoleInputs;
    type Extras = Option<Roles>;
    const COUPLED: bool = true;
    const DRAWS: bool = true;

    fn parts(&self) -> &ValueParts {
        &self.parts
    }

    fn measures(&self) -> &'static [Measure] {
        &MEASURES
    }

    fn draw(&self, batch: &[&Episode], draw: Draw) -> RoleNoise {
        let mut streams = [Stream::RoleNoise, Stream::TargetRoleNoise].map(|stream| draw.stream(stream));
        let noise = batch.iter().map(|episode| {
            let len = (episode.steps() + 1) * episode.n_agents * self.config.dim;
            streams.each_mut().map(|rng| standard_normal(rng, len))
        });
        noise.collect()
    }

    /// In training, roles are sampled with noise from the episode's stream; in evaluation the noise is zero, so an
    /// agent's role is its distribution's mean.
    fn draw_acting(&self, turns: &mut [Turn<'_>]) -> RoleNoise {
        let noise = turns.iter_mut().map(|turn| {
            let len = turn.actions.len() * self.config.dim;
            let drawn = turn.exploration.stream().map(|rng| standard_normal(rng, len));
            [drawn.unwrap_or_else(|| vec![0.0; len]), Vec::new()]
        });
        noise.collect()
    }

    fn inputs(&self, rows: &Rows, noise: &RoleNoise, first_episode: usize) -> RoleInputs {
        let mut inputs = RoleInputs::default();
        for (group, step) in rows.groups.iter().zip(&rows.steps) {
            let len = group.queries.len() * self.config.dim;
            for (to, from) in inputs.noise.iter_mut().zip(&noise[first_episode + step.episode]) {
                // Acting draws nothing for a target network.
                to.extend(from.iter().skip(step.time * len).take(len));
            }
            if step.filled {
                for first in group.queries.clone() {
                    for second in group.queries.clone() {
                        inputs.pairs[0].push(first);
                        inputs.pairs[1].push(second);
                    }
                }
            }
        }
        inputs
    }

    fn forward<'a>(&self, tape: &mut Tape<'a>, pass: Pass<'a, RoleInputs>) -> Utilities<'a, Option<Roles>> {
        let Pass { rows, inputs, .. } = pass;
        let shown = self.encode(tape, &self.role_encoder, rows);
        let role = self.role.forward(tape, &[shown]);
        let noise = &inputs.noise[usize::from(pass.role == Role::Target)];
        let sample = tape.sample(role.mean, role.variance, View::dense(noise, self.config.dim));

        let encoded = self.encode(tape, &self.encoder, rows);
        let gates = tape.product_of(&self.gru.input, 0, &[encoded]);
        tape.free(encoded);
        let memory = tape.gru(&self.gru, gates, &rows.agent_times, pass.before);
        let hidden = tape.linear(&self.role_hidden, sample);
        let normed = tape.layer_norm(&self.role_norm, hidden);
        let code = tape.leaky_relu(normed);
        let head = Head::Independent(tape.generated(&self.head, memory, code));
        if pass.role != Role::Online {
            for var in [shown, hidden, normed, code] {
                tape.free(var);
            }
            return Utilities { memory, head, extras: None };
        }
        // The posterior reads the history before this step and the present observation; its gradient reaches neither.
        let parts = [tape.detached_predecessors(memory, &rows.agent_times), tape.detach(shown)];
        let posterior = self.posterior.forward(tape, &parts);
        Utilities { memory, head, extras: Some(Roles { role, sample, posterior }) }
    }

    /// Entropy and divergence over rows, and L_D, which couples nothing and is seeded here.
    fn sums<'a>(&self, tape: &mut Tape<'a>, pass: &TdPass<'a, '_, Self>, said: &mut Said) -> Sums {
        let Some(roles) = pass.extras else { return Sums::new() };
        let [entropy, divergence] = losses::row_sums(tape, pass.rows, roles);
        let rows = pass.totals.filled_agents as f64;
        let dissimilarity = self.dissimilarity.loss(tape, pass, roles, &self.config, said);
        said.extend([
            ("role_mean", roles.role.mean),
            ("role_variance", roles.role.variance),
            ("role", roles.sample),
            ("role_posterior_mean", roles.posterior.mean),
            ("role_posterior_variance", roles.posterior.variance),
        ]);
        vec![entropy / rows, divergence / rows, dissimilarity]
    }

    fn losses(&self, sums: &[f64]) -> Vec<f64> {
        let (loss, _) = losses::role_loss(sums, &self.config);
        vec![loss, sums[0], sums[1], sums[2]]
    }

    fn seed(&self, tape: &mut Tape<'_>, rows: &Rows, totals: Totals, extras: &Option<Roles>, sums: &[f64]) {
        if let Some(roles) = extras {
            let (_, slope) = losses::role_loss(sums, &self.config);
            losses::seed_rows(tape, rows, roles, &self.config, (slope / totals.filled_agents as f64) as f32);
        }
    }
}
