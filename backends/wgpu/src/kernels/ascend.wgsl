let p = penalty_ascend(vec3<f32>(dual_x[i], dual_y[i], dual_z[i]), differences(place(i)), GUIDE);
        dual_x[i] = p.x;
        dual_y[i] = p.y;
        dual_z[i] = p.z;
