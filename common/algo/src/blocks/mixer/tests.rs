use super::*;
use crate::blocks::testing::{D, Named, assert_close, relu, rows, shown, wide};
use rit_nn::{
    Stock,
    gradcheck::{check, check_operation, noise, run_operation},
};

/// Mixing layers of 3, hyper-networks of 4, over `context` numbers of a task representation.
fn unit(heads: usize, context: usize) -> (Mixer, Named) {
    Named::of(|layout| {
        let encoder = Encoder::new(layout, "mixer", D, 5, 4, heads);
        Mixer::new(layout, encoder, context, 3, 4)
    })
}

/// The mixing network as the specification has it.
struct Reference<'r> {
    named: &'r Named,
    heads: usize,
    rows: &'r Rows,
}

impl Reference<'_> {
    fn relu(&self, name: &str, x: &[f64]) -> Vec<f64> {
        relu(self.named.linear(name, x))
    }

    /// e_k of the agent at a place among its group's entities, over those it is shown.
    fn state(&self, entities: &[Vec<f64>], place: usize, shown: &[Vec<f64>]) -> Vec<f64> {
        let attended = self.named.attention("mixer.attention", self.heads, &entities[place], shown);
        self.named.linear("mixer.out", &attended)
    }

    /// A row of W₁ from c_k.
    fn w1(&self, c: &[f64]) -> Vec<f64> {
        let signed = self.named.linear("mixer.w1", &self.relu("mixer.w1_hidden", c));
        signed.into_iter().map(f64::abs).collect()
    }

    /// Equation 15 for a group. `rows_of` gives what of W₁ and of the utilities each agent's place adds.
    fn q_total(
        &self,
        group: &Group,
        representation: impl Fn(usize) -> Vec<f64>,
        rows_of: impl Fn(&[Vec<f64>], usize, &[f64]) -> Vec<(f64, Vec<f64>)>,
    ) -> f64 {
        let entities = self.named.embedded("mixer", self.rows, group);
        let count = group.queries.len() as f64;
        let (mut hidden, mut w2, mut b2) = ([0.0; 3], [0.0; 3], 0.0);
        for (place, row) in group.queries.clone().enumerate() {
            let c = [self.state(&entities, place, &entities), representation(row)].concat();
            let of_w2 = self.named.linear("mixer.w2", &self.relu("mixer.w2_hidden", &c));
            let of_b1 = self.named.linear("mixer.b1", &c);
            b2 += self.named.linear("mixer.b2", &self.relu("mixer.b2_hidden", &c))[0] / count;
            for at in 0..3 {
                w2[at] += of_w2[at] / count;
                hidden[at] += of_b1[at] / count;
            }
            for (q, w1) in rows_of(&entities, place, &c) {
                (0..3).for_each(|at| hidden[at] += q * w1[at]);
            }
        }
        let elu = |x: f64| if x > 0.0 { x } else { x.exp() - 1.0 };
        b2 + (0..3).map(|at| elu(hidden[at]) * w2[at].abs()).sum::<f64>()
    }
}

#[test]
fn q_total_follows_equation_15() {
    let rows = rows();
    let (q, z) = (noise(2, rows.agent_rows()), noise(3, rows.agent_rows() * 2));
    for (heads, context) in [(1, 2), (2, 2), (2, 0)] {
        let (mixer, named) = unit(heads, context);
        let reference = Reference { named: &named, heads, rows: &rows };
        let of_group = |group: &Group| {
            let representation = |row: usize| wide(&z[row * 2..][..context]);
            let chosen = &q[group.queries.clone()];
            reference.q_total(group, representation, |_, place, c| {
                vec![(f64::from(chosen[place]), reference.w1(c))]
            })
        };
        let theirs: Vec<f64> = rows.groups.iter().map(of_group).collect();
        let ours = run_operation(&named.params, &[(&q, 1), (&z, 2)], |tape, x| {
            let weights = mixer.weights(tape, &rows, (context > 0).then_some(x[1]));
            mixer.mix(tape, &rows.groups, &weights, x[0])
        });
        assert_close("q_total", &ours, &theirs);
    }
}

#[test]
fn a_larger_utility_never_makes_q_total_smaller() {
    let rows = rows();
    let (mixer, named) = unit(2, 0);
    let q_total = |q: &[f32]| {
        run_operation(&named.params, &[(q, 1)], |tape, x| {
            let weights = mixer.weights(tape, &rows, None);
            mixer.mix(tape, &rows.groups, &weights, x[0])
        })
    };
    let q = noise(2, rows.agent_rows());
    let before = q_total(&q);
    for (at, group) in rows.groups.iter().enumerate() {
        for row in group.queries.clone() {
            let mut larger = q.clone();
            larger[row] += 0.5;
            let after = q_total(&larger);
            assert!(after[at] > before[at], "row {row}: {} {}", before[at], after[at]);
            let unchanged = (0..before.len()).all(|other| other == at || after[other] == before[other]);
            assert!(unchanged, "row {row} counts in its own group alone");
        }
    }
}

/// Derived layers count as parameters here: what they are made of has a test of its own.
#[test]
fn gradients_are_the_numeric_ones() {
    let rows = rows();
    let count = rows.agent_rows();
    for heads in [1, 2] {
        let (mixer, named) = unit(heads, 2);
        check_operation(named.params.len(), &[(count, 1), (count, 2)], |tape, x| {
            let weights = mixer.weights(tape, &rows, Some(x[1]));
            mixer.mix(tape, &rows.groups, &weights, x[0])
        });
    }
}

/// REFIL's imagined mixing: every agent has two utilities, each with a row of W₁ made under a mask of its own, and all
/// else is the ordinary pass's.
struct Imagined {
    rows: Rows,
    masks: [Vec<u8>; 2],
    /// Groups in which every agent has two rows.
    pairs: Vec<Group>,
    mixer: Mixer,
}

impl Imagined {
    fn new() -> (Self, Named) {
        let rows = rows();
        let (mixer, named) = unit(2, 0);
        // What the first shows, the second does not; the agent that is alone with another entity is shown both, or none.
        let small: Vec<usize> = (3 * 5..3 * 5 + 2).collect();
        let first: Vec<u8> =
            (0..rows.observable.len()).map(|pair| u8::from(small.contains(&pair) || pair % 3 == 0)).collect();
        let second = first.iter().map(|flag| 1 - flag).collect();
        let pair = |group: &Group| Group {
            queries: 2 * group.queries.start..2 * group.queries.end,
            keys: group.keys.clone(),
        };
        let pairs = rows.groups.iter().map(pair).collect();
        (Self { rows, masks: [first, second], pairs, mixer }, named)
    }

    /// Q_total of each group, and its gradients by parameters and utilities where it is weighed with `to`.
    fn run(&self, params: &[f32], q: &[f32], to: &[f32]) -> [Vec<f32>; 3] {
        let mut tape = Tape::recording(params, Stock::default());
        let input = tape.input(View::dense(q, 1));
        let masks = self.masks.each_ref().map(|flags| Visible::Where(flags));
        let weights = self.mixer.weights(&mut tape, &self.rows, None);
        let weights = self.mixer.weights_under(&mut tape, &self.rows, &weights, &masks);
        let out = self.mixer.mix(&mut tape, &self.pairs, &weights, input);
        let q_total = tape.slice(out).to_vec();
        tape.seed(out, View::dense(to, 1));
        let mut grads = vec![0.0; params.len()];
        tape.backward(&mut grads);
        let by_q = tape.gradient(input);
        let by_q = (0..by_q.rows).flat_map(|row| by_q.row(row).to_vec()).collect();
        [q_total, grads, by_q]
    }
}

#[test]
fn under_masks_only_w1_is_another() {
    let (imagined, named) = Imagined::new();
    let rows = &imagined.rows;
    let reference = Reference { named: &named, heads: 2, rows };
    let q = noise(2, 2 * rows.agent_rows());
    let mut first_pair = 0;
    let theirs: Vec<f64> = rows
        .groups
        .iter()
        .map(|group| {
            let m = group.keys.len();
            let pairs = first_pair;
            first_pair += group.queries.len() * m;
            reference.q_total(
                group,
                |_| vec![],
                |entities, place, _| {
                    let of_mask = |mask: usize| {
                        let flags = &imagined.masks[mask][pairs + place * m..][..m];
                        let state = reference.state(entities, place, &shown(flags, entities));
                        (f64::from(q[2 * (group.queries.start + place) + mask]), reference.w1(&state))
                    };
                    vec![of_mask(0), of_mask(1)]
                },
            )
        })
        .collect();
    let [ours, ..] = imagined.run(&named.params, &q, &noise(3, rows.groups.len()));
    assert_close("imagined q_total", &ours, &theirs);
}

#[test]
fn gradients_under_masks_are_the_numeric_ones() {
    let (imagined, named) = Imagined::new();
    let (q, to) = (noise(2, 2 * imagined.rows.agent_rows()), noise(3, imagined.rows.groups.len()));
    let [_, by_params, by_q] = imagined.run(&named.params, &q, &to);
    let loss = |params: &[f32], q: &[f32]| {
        let [q_total, ..] = imagined.run(params, q, &to);
        q_total.iter().zip(&to).map(|(q_total, to)| f64::from(q_total * to)).sum()
    };
    check("params", &named.params, &by_params, |params| loss(params, &q));
    check("utilities", &q, &by_q, |q| loss(&named.params, q));
}
